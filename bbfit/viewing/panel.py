"""The controls of one visitor's page."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from bbfit.exporting.config import ExportConfig
from bbfit.geometry.alpha import AlphaKind
from bbfit.viewing.field import MOST
from bbfit.viewing.levels import choose_level
from bbfit.viewing.models import Look
from bbfit.viewing.panes import STEPS, Picture, Reach, meters
from bbfit.viewing.subject import Subject

if TYPE_CHECKING:
    import viser

BOTH, ORIGINAL, BILLBOARDS, FIELD = "side by side", "original", "billboards", "field"
"""What can be shown."""
BY_DISTANCE = "by distance"
"""The choice of level that follows the camera."""
ALPHAS: tuple[AlphaKind, ...] = ("mask", "blend", "hash")
"""The alpha modes."""
HELD = 0.5
"""Seconds in which the slider is left alone once it was moved by hand."""
# A smaller change of the distance, as a share of it, is rounding.
_SAME = 2e-3


class Panel:
    """Controls, and what they say; every change calls one of three functions. ``height`` is the tree's, in meters."""

    def __init__(
        self,
        gui: viser.GuiApi,
        height: float,
        *,
        on_change: Callable[[], None],
        on_distance: Callable[[float], None],
        on_plant: Callable[[], None],
    ) -> None:
        self._distance, self._on_distance, self._slid = 1.0, on_distance, 0.0
        self.reach = reach = Reach(0.5 * height, 200 * height)
        # viser's values can be set, though its types do not say so.
        self.status = gui.add_markdown("")
        self.notes = gui.add_markdown("")
        self.show: Any = gui.add_dropdown("show", (BOTH, ORIGINAL, BILLBOARDS, FIELD), hint="one camera looks at both trees")
        self.outlines: Any = gui.add_checkbox("plane outlines", False)
        self.alpha: Any = gui.add_dropdown("alpha mode", ALPHAS, hint="what the textures' alpha means to the program that draws the model")
        self.split: Any = gui.add_checkbox(
            "cut up for sorting", False, hint="as exports for three.js are, of use with blend; takes up to minutes"
        )
        self.alpha_note = gui.add_markdown("")
        self.level: Any = gui.add_dropdown(
            "level", (BY_DISTANCE,), hint="level of detail: a fixed one, or the one that the distance allows"
        )
        marks = tuple((step, meters(reach.distance(step))) for step in (0, STEPS // 2, STEPS))
        self.slider: Any = gui.add_slider("distance", 0, STEPS, 1, 0, marks=marks, hint="equal steps are equal factors")
        self.meters: Any = gui.add_number("meters", 1.0, min=1e-3, step=0.1, hint="from the camera to the tree's middle")
        self.readout = gui.add_markdown("")
        with gui.add_folder("Plant a field"):
            self.trees: Any = gui.add_number("trees", 1000, min=1, max=MOST, step=1)
            self.seed: Any = gui.add_number("seed", 0, min=0, step=1, hint="of places, turns and sizes")
            self.plant = gui.add_button("Plant")
        for handle in (self.show, self.outlines, self.alpha, self.split, self.level):
            handle.on_update(lambda _: on_change())
        self.slider.on_update(lambda _: self._ask(self.reach.distance(self.slider.value), step=True))
        self.meters.on_update(lambda _: self._ask(float(self.meters.value), step=False))
        self.plant.on_click(lambda _: on_plant())

    def fit(self, subject: Subject, *, first: bool) -> None:
        """Offer what a subject has; with ``first`` the choices are set to what suits it."""
        names = tuple(level.name for level in subject.levels)
        self.level.options = (*names, BY_DISTANCE)
        self.show.options = (BOTH, ORIGINAL, BILLBOARDS, FIELD) if subject.original.glb is not None else (BILLBOARDS, FIELD)
        if first or (self.level.value == ORIGINAL and subject.original.glb is None):
            self.level.value = subject.clouds[0].name
        if first:
            self.show.value = BOTH if subject.original.glb is not None else BILLBOARDS
            self.alpha.value = fitted_alpha(subject)
            self.split.value = bool(subject.export.resolve().split)
        self.notes.content = "\n\n".join(filter(None, (*subject.notes, subject.original.note)))

    @property
    def look(self) -> Look:
        """How the billboards are to be exported."""
        return Look(self.alpha.value, bool(self.split.value) and self.alpha.value == "blend")

    def chosen(self, subject: Subject, scale: float) -> int:
        """Which level is to be shown at so many pixels a meter."""
        if self.level.value == BY_DISTANCE:
            return choose_level(subject.levels, scale)
        names = [level.name for level in subject.levels]
        return names.index(self.level.value) if self.level.value in names else len(names) - len(subject.clouds)

    def tell_distance(self, distance: float) -> None:
        """Set slider and number to where the camera is, in meters."""
        self._distance = distance
        if time.monotonic() - self._slid > HELD:
            self.slider.value = self.reach.step(distance)
        if abs(self.meters.value / distance - 1) > _SAME / 2:
            self.meters.value = float(f"{distance:.4g}")

    def tell_levels(self, subject: Subject, picture: Picture, chosen: int) -> None:
        """Say how large the tree is on the screen, and from where on each level is shown."""
        scale, focal = picture.pixels_a_meter(self._distance), picture.pixels_a_meter(1.0)
        lines = [f"{meters(self._distance)} away the tree is **{scale * subject.size[1]:,.0f} pixels** tall."]
        for index, level in enumerate(subject.levels) if len(subject.levels) > 1 else ():
            distance = level.distance(focal)
            if distance is None:
                where = "not known: " + ("the fit is not done" if subject.live else "being measured" if subject.views else "no views")
            else:
                where = f"may be shown from {meters(distance)} on" if distance else "from 0 m on"
            lines.append(f"- {'**' if index == chosen else ''}{level.name}{'**' if index == chosen else ''}: {where}")
        self.readout.content = "\n".join([lines[0], "", *lines[1:]])

    def tell_alpha(self, subject: Subject) -> None:
        """Say what is to be known of the alpha mode that is chosen."""
        kind, fitted = self.alpha.value, fitted_alpha(subject)
        told = [] if kind == fitted else [f"The textures were fitted for {fitted}."]
        if kind == "hash":
            told.append("glTF has no hash: the file says BLEND and names HASH in its extras, and viewers such as this one blend.")
        if kind != "mask" and not self.look.split:
            told.append("Billboards that cross are blended in a wrong order here, as in every program that sorts whole meshes.")
        self.alpha_note.content = " ".join(told)
        self.split.disabled = kind != "blend"

    def _ask(self, distance: float, *, step: bool) -> None:
        """Pass a wish on, unless it is but what the panel was told itself."""
        own = self.reach.step(self._distance) == self.slider.value if step else abs(distance / self._distance - 1) < _SAME
        if not own:
            self._slid = time.monotonic() if step else 0.0
            self._on_distance(distance)


def fitted_alpha(subject: Subject) -> Any:
    """The alpha mode that a run's models have."""
    cloud = subject.clouds[0].cloud
    assert cloud is not None
    export: ExportConfig = subject.export
    return export.alpha or cloud.alpha.kind
