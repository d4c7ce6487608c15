"""One visitor of the page: a browser's controls, camera and scene."""

from __future__ import annotations

import colorsys
import itertools
import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from bbfit.viewing.background import Background
from bbfit.viewing.field import plant
from bbfit.viewing.levels import Level, field_levels
from bbfit.viewing.models import Key, Look, Model, Models, model_key
from bbfit.viewing.panel import BILLBOARDS, BOTH, BY_DISTANCE, FIELD, HELD, ORIGINAL, Panel
from bbfit.viewing.panes import Picture
from bbfit.viewing.planted import Planted
from bbfit.viewing.subject import Subject, outlines

if TYPE_CHECKING:
    import viser

ROOTS = {ORIGINAL: "/original", BILLBOARDS: "/billboards", FIELD: "/field"}
"""The nodes under which things are; the page's script shows them by pane."""
_MODES = {BOTH: "split", ORIGINAL: "original", BILLBOARDS: "billboards", FIELD: "field"}
# Seconds in which the browser draws without a pause to measure a frame, after which old models go, and between two rounds of levels.
_MEASURED, _KEPT, _ROUND = 1.5, 0.6, 0.25
# How far above the horizon the camera is at first, and its vertical field of view, in degrees.
_ELEVATION, _FOV_DEGREES = 5.0, 40.0
_NUMBERS = itertools.count()

Send = Callable[["viser.ClientHandle", dict[str, Any], float], None]
"""Sends a state to the page's script, and for how many seconds it is to measure."""


class Visitor:
    """One browser that shows a subject; safe to use from several threads."""

    def __init__(self, client: viser.ClientHandle, send: Send, background: Background) -> None:
        self.client, self._send, self._background = client, send, background
        self._lock = threading.RLock()
        self._subject: Subject | None = None
        self._models: Models | None = None
        self._nodes: dict[Key, viser.GlbHandle] = {}
        self._lines: viser.LineSegmentsHandle | None = None
        self._lined = -1
        self._planted: Planted | None = None
        self._sown: tuple[Any, ...] = ()
        self._making = set[Key]()
        self._mode, self._rounded, self._status = "", 0.0, ""
        self._shown: Key | None = None
        self._told: dict[str, Any] = {}
        self._fitted: tuple[Picture, Any] | None = None
        self._arrived = self._gone = False
        self.panel: Panel
        """Its controls, there once something is shown."""
        client.camera.on_update(lambda _: self.follow())
        self._waiting: viser.GuiMarkdownHandle | None = client.gui.add_markdown("Waiting for the first billboards …")
        send(client, {"mode": "billboards", "right": ["waiting for the first billboards"]}, 0)

    def show(self, subject: Subject, models: Models) -> None:
        """Show another subject, or another state of the same."""
        with self._lock:
            if self._gone:
                return
            first = self._subject is None or (self._subject.live and not subject.live)
            start = self._subject is None
            self._subject, self._models = subject, models
            if start:
                if self._waiting is not None:
                    self._waiting.remove()
                self.panel = Panel(self.client.gui, subject.size[1], on_change=self.apply, on_distance=self.go, on_plant=self.sow)
            self.panel.fit(subject, first=first)
            self.panel.status.content = self._status
            if start:
                self.look_at_tree()
            self.apply()

    def say(self, status: str) -> None:
        """Say something about work in progress, as of the fit."""
        with self._lock:
            self._status = status
            if self._gone:
                return
            self._send(self.client, {"status": status}, 0)
            if self._subject is not None:
                self.panel.status.content = status
            elif self._waiting is not None:
                self._waiting.content = f"Waiting for the first billboards. {status}"

    def leave(self) -> None:
        """Do nothing more: the browser is gone."""
        self._gone = True

    @property
    def subject(self) -> Subject:
        """What it shows."""
        assert self._subject is not None
        return self._subject

    @property
    def planted(self) -> Planted | None:
        """The field, once one is planted."""
        return self._planted

    @property
    def picture(self) -> Picture:
        """The browser's picture."""
        camera = self.client.camera
        return Picture(max(camera.image_width, 1), max(camera.image_height, 1), camera.fov, self.panel.show.value == BOTH)

    @property
    def distance(self) -> float:
        """Meters between the camera and the tree's middle."""
        assert self._subject is not None
        return max(float(np.linalg.norm(self.client.camera.position - self._subject.middle)), 1e-6)

    def look_at_tree(self) -> None:
        """Put the camera where the views begin, a little higher, so that the whole tree is in the picture.

        As long as nobody moves it, it stays so when the picture's size changes.
        """
        assert self._subject is not None
        subject, elevation = self._subject, math.radians(_ELEVATION)
        self.client.camera.fov = math.radians(_FOV_DEGREES)
        away = self.picture.distance_to_fit(*subject.size) + subject.size[0] / 4
        self._place(eye := subject.middle + away * np.array([0.0, math.sin(elevation), math.cos(elevation)]))
        self._fitted, self._arrived = (self.picture, eye), False

    def go(self, distance: float) -> None:
        """Move the camera to a distance in meters from the tree's middle, on the line between them."""
        with self._lock:
            if self._subject is not None and not self._gone:
                self._fitted = None
                middle = self._subject.middle
                self._place(middle + (self.client.camera.position - middle) * (distance / self.distance))
                self.follow()
                self._background.start(self.follow, after=2 * HELD)  # when the slider is let go

    def follow(self) -> None:
        """Let controls and levels follow the camera."""
        with self._lock:
            if self._subject is None or self._gone:
                return
            self._keep_fitted()
            self.panel.tell_distance(self.distance)
            if self._mode == FIELD:
                self._share_out()
            if self.panel.level.value == BY_DISTANCE:
                self.apply(measure=False)
            else:
                self._tell()

    def sow(self) -> None:
        """Plant a field of as many trees as the panel says, and show it."""
        with self._lock:
            if self.panel.show.value != FIELD:
                self.panel.show.value = FIELD  # which comes back here
            else:
                self.apply()

    def apply(self, *, measure: bool = True) -> None:
        """Show what the controls say."""
        with self._lock:
            if self._subject is None or self._gone:
                return
            subject, mode = self._subject, self.panel.show.value
            if mode != self._mode:
                self._change_mode(mode)
            chosen = self.panel.chosen(subject, self.picture.pixels_a_meter(self.distance))
            self.panel.tell_alpha(subject)
            if mode == FIELD:
                self._apply_field()
            else:
                self._apply_level(subject.levels[chosen])
            self._tell(_MEASURED if measure else 0.0)

    def _change_mode(self, mode: str) -> None:
        assert self._subject is not None
        before, self._mode = self._mode, mode
        if mode == FIELD:
            height = self._subject.size[1]
            side = plant(int(self.panel.trees.value), self._subject.bounds).side
            self._fitted = None
            self.client.camera.far = max(1000.0, 4 * side)
            self._place(self._subject.middle + np.array([0.0, 0.05 * side + 1.5 * height, 0.5 * side + 2 * height]))
        elif before == FIELD:
            self.look_at_tree()

    def _keep_fitted(self) -> None:
        """Fit the tree into a picture of another size, unless the camera was moved."""
        assert self._subject is not None
        if self._fitted is None:
            return
        picture, eye = self._fitted
        there = np.allclose(self.client.camera.position, eye, rtol=1e-3, atol=1e-3 * self._subject.size[1])
        if self._arrived and not there:
            self._fitted = None
        elif picture != self.picture:
            self.look_at_tree()
        self._arrived = self._arrived or there

    def _place(self, eye: Any) -> None:
        assert self._subject is not None
        camera = self.client.camera
        with self.client.atomic():
            camera.up_direction = (0.0, 1.0, 0.0)
            camera.position = eye
            camera.look_at = self._subject.middle

    def _apply_level(self, level: Level) -> None:
        """The level's billboards in the scene, and every level's where the distance chooses among them."""
        assert self._subject is not None
        look = self.panel.look
        wanted = self._subject.clouds if self.panel.level.value == BY_DISTANCE else (level,)
        models = {each.mark: self._model(each, look) for each in wanted if each.cloud is not None}
        if level.cloud is not None and models[level.mark] is None:
            return  # it is being made; what is shown stays till then
        for each in wanted:
            model = models.get(each.mark)
            if model is not None and (key := model_key(each, look)) not in self._nodes:
                name = f"{ROOTS[BILLBOARDS]}/{next(_NUMBERS)}"
                self._nodes[key] = self.client.scene.add_glb(name, model.glb, cast_shadow=False, receive_shadow=False)
        if level.cloud is None:
            return  # the script shows the original in place of them
        self._nodes[model_key(level, look)].visible = True
        kept = {model_key(each, look) for each in wanted}
        self._shown = model_key(level, look)
        if any(key != self._shown and (node.visible or key not in kept) for key, node in self._nodes.items()):
            self._background.start(lambda: self._tidy(kept), after=_KEPT)  # when the new one is surely drawn
        self._outline(level)

    def _tidy(self, kept: set[Key]) -> None:
        """Hide the levels that are not shown, and remove what is not wanted any more."""
        with self._lock:
            for key, node in list(self._nodes.items()) if not self._gone else ():
                if key != self._shown and key in kept:
                    node.visible = False
                elif key != self._shown:
                    node.remove()
                    del self._nodes[key]

    def _outline(self, level: Level) -> None:
        if self._lines is not None and (self._lined != level.mark or not self.panel.outlines.value):
            self._lines.remove()
            self._lines = None
        if self.panel.outlines.value and self._lines is None:
            assert level.cloud is not None
            segments = outlines(level.cloud)
            hues = np.arange(len(level.cloud)) / len(level.cloud)
            colors = np.array([[round(255 * c) for c in colorsys.hsv_to_rgb(hue, 0.9, 0.8)] for hue in hues], np.uint8)
            self._lines = self.client.scene.add_line_segments(
                f"{ROOTS[BILLBOARDS]}/outlines-{next(_NUMBERS)}",
                segments,
                np.repeat(np.repeat(colors, 4, 0)[:, None], 2, 1),
                thickness=2.0,
                thickness_units="screen",
            )
            self._lined = level.mark

    def _apply_field(self) -> None:
        assert self._subject is not None
        look = Look(self.panel.look.alpha)  # pieces that are sorted node by node cannot be sorted among instances
        if self.panel.level.value == BY_DISTANCE:
            levels = field_levels(self._subject.levels)
        else:
            level = self._subject.levels[self.panel.chosen(self._subject, math.inf)]
            levels = field_levels([level if level.cloud is not None else self._subject.clouds[0]])[:1]
        found = [(level, model) for level in levels if (model := self._model(level, look)) is not None]
        if not found or found[0][0] is not levels[0]:
            return
        levels, made = tuple(level for level, _ in found), [model for _, model in found]  # the others come when they are made
        sown: Any = (int(self.panel.trees.value), int(self.panel.seed.value), *(model_key(level, look) for level in levels))
        if sown == self._sown and self._planted is not None:
            return
        if self._planted is not None:
            self._planted.remove()
        field = plant(sown[0], self._subject.bounds, seed=sown[1])
        self._sown = sown
        self._planted = Planted(self.client, ROOTS[FIELD], field, levels, made)
        self._rounded = 0.0
        self._share_out()

    def _share_out(self) -> None:
        """Levels of the field's trees, not more often than is of use."""
        now = time.monotonic()
        if self._planted is None:
            return
        if now - self._rounded < _ROUND:
            self._background.start(lambda: self._catch_up(now), after=_ROUND)
            return
        self._rounded = now
        self._planted.share_out(self.client.camera.position, self.picture.pixels_a_meter(1.0))

    def _catch_up(self, since: float) -> None:
        with self._lock:
            if self._planted is not None and self._rounded < since and not self._gone:
                self._share_out()
                self._tell()

    def _model(self, level: Level, look: Look) -> Model | None:
        """A level's model; if it is not there, it is made in the background and then shown."""
        assert self._models is not None
        models, key = self._models, model_key(level, look)
        model = models.made(level, look)
        if model is None and key not in self._making:
            self._making.add(key)

            def make() -> None:
                models.make(level, look)
                with self._lock:
                    self._making.discard(key)
                    self.apply()

            self._background.start(make)
        return model

    def _tell(self, seconds: float = 0.0) -> None:
        """Labels and readouts; for so many seconds the page is to measure frames."""
        assert self._subject is not None and self._models is not None
        subject, look = self._subject, self.panel.look
        chosen = self.panel.chosen(subject, self.picture.pixels_a_meter(self.distance))
        self.panel.tell_levels(subject, self.picture, chosen)
        level = subject.levels[chosen]
        busy = "making the model … " if self._making else ""
        left = ["original"]
        if subject.original.glb is not None:
            count = subject.original.vertices
            left.append((f"{count:,} vertices · " if count else "") + _size(len(subject.original.glb)))
        right = list(left)
        if self.panel.show.value == FIELD:
            right = self._field_lines()
        elif level.cloud is not None:
            model = self._models.made(level, look)
            counts = f"{model.vertices:,} vertices · {_size(len(model.glb))} · " if model is not None else ""
            right = [level.name, f"{counts}{look.alpha}{', cut up' if look.split else ''}"]
        mode = _MODES[self.panel.show.value]
        if mode == "billboards" and level.cloud is None:
            mode = "original"
        state = {"mode": mode, "near": level.cloud is None, "left": left, "right": right, "status": busy + self._status}
        if state != self._told or seconds:
            self._told = state
            self._send(self.client, state, seconds)

    def _field_lines(self) -> list[str]:
        if self._planted is None:
            return ["planting …"]
        planted = self._planted
        shares = [f"{count:,}" for count in planted.counts]
        levels = f" · levels by distance: {' / '.join(shares)}" if len(shares) > 1 else ""
        return [f"{len(planted):,} trees", f"{planted.vertices:,} vertices{levels}"]


def _size(count: int) -> str:
    return f"{count / 2**20:.1f} MiB" if count >= 1 << 20 else f"{count / 1024:,.0f} KiB"
