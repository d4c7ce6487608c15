"""The short fits that a budget compares: their cost, and their quality on validation views."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from bbfit.budget.sizes import picture_bytes
from bbfit.evaluation.scoring import views_psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.bark import Bark
from bbfit.fitting.config import FitConfig, Placement, Sides
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.fitting.loop import fit
from bbfit.fitting.points import placement_points
from bbfit.fitting.requirements import check_cameras, check_device
from bbfit.fitting.search import QUICK, find_placement
from bbfit.geometry.cloud import BillboardCloud
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

# The length of a short fit and of its search, if the configuration asks for no shorter ones. The search is at lower resolutions than the
# levels, of which an even placement, without a search, has as many as any fit. Shorter fits would favor few billboards.
_MOST: dict[str, int] = {"steps": 200, "restarts": 1, "candidates": 4, "refinement_rounds": 0}
_LEVELS, _VIEWS_PER_STEP = 2, 2


@dataclass(frozen=True)
class Trial:
    """The cost and the quality of a short fit of a configuration."""

    billboards: int
    """Number of billboards."""
    sides: Sides
    """As in :class:`bbfit.fitting.config.FitConfig`."""
    placement: Placement
    """As in :class:`bbfit.fitting.config.FitConfig`."""
    max_texels: int | None
    """Limit of texels of the fit."""
    vertices: int
    """Vertices of the billboards: four for each texture."""
    texels: int
    """Texels of all textures."""
    density: float
    """Texels per area, as a share of what the configuration asks for, in (0, 1]; less than 1 where a limit of texels lowers it."""
    bytes: int
    """Size of the model as GLB, in bytes."""
    texture_bytes: int
    """Size of the pictures in the GLB, in bytes."""
    psnr: float
    """PSNR in dB, the mean over the validation views and the backgrounds (:data:`bbfit.evaluation.backgrounds.BACKGROUNDS`)."""
    seconds: float
    """Duration of the trial."""

    @property
    def textures(self) -> int:
        """Number of textures: one for each side of the billboards that has its own."""
        return self.vertices // 4


Known = Callable[[FitConfig], Trial | None]
"""Returns the trial of a configuration, or ``None`` if it is not known."""
OnTrial = Callable[[list[Trial], int], None]
"""Called with all trials so far, and with their expected total number."""


def lookup(trials: Sequence[Trial]) -> Known:
    """Return a function that finds the trial of a configuration among those of an earlier call with the same arguments."""
    by_choice = {(trial.billboards, trial.sides, trial.placement, trial.max_texels): trial for trial in trials}
    return lambda config: by_choice.get((config.billboards, config.sides, config.placement, config.max_texels))  # type: ignore[arg-type]


class Trials:
    """Short fits to the training split of views, scored on their test split.

    All fits with the same number of billboards and sides start from the same placement, which one quick search finds.
    """

    def __init__(
        self,
        views: ViewDataset,
        config: FitConfig,
        tree: TreeFile | None,
        export: ExportConfig,
        known: Known | None = None,
        on_trial: OnTrial | None = None,
    ) -> None:
        self._views, self._config, self._tree, self._export = views, config, tree, export
        self._known, self._on_trial = known or (lambda config: None), on_trial or (lambda trials, total: None)
        self._points: tuple[Tensor, Bark | None] | None = None
        self._placements = dict[tuple[int | None, Sides], BillboardCloud]()
        self.done: list[Trial] = []
        """All trials, in order."""
        self.expected = 0
        """Expected total number of trials, which ``on_trial`` is told."""

    def run(self, count: int, sides: Sides, placement: Placement, max_texels: int | None) -> Trial:
        """Add the trial of a configuration. Run a short fit unless the trial is known."""
        config = short_config(self._config, count, sides, placement, max_texels)
        trial = self._known(config) or self._fitted(config, count, placement)
        self.done.append(trial)
        self._on_trial(list(self.done), self.expected)
        return trial

    def _fitted(self, config: FitConfig, count: int, placement: Placement) -> Trial:
        started = time.perf_counter()
        start = None if placement == "even" else self._placement(config)
        result = fit(self._views, config, tree=self._tree, placement=start)
        cloud, asked = result.cloud, result.config.texel_density * float(pixels_per_meter(self._views.train.cameras))
        density = float((cloud.texture_sizes.flip(-1) / (2 * cloud.half_extents)).median() / asked) ** 2
        model = shipped_model(cloud, self._export)
        psnr, seconds = round(views_psnr(model.draw, self._views.test), 3), round(time.perf_counter() - started, 1)
        texels, sizes = len(cloud.texels), (len(model.glb), picture_bytes(model.glb))
        most = config.max_texels
        return Trial(count, config.sides, placement, most, cloud.vertex_count, texels, min(1.0, round(density, 4)), *sizes, psnr, seconds)

    def _placement(self, config: FitConfig) -> BillboardCloud:
        """The placement of a number of billboards, which one search finds for all limits of texels."""
        kind, views = (config.billboards, config.sides), self._views
        if kind not in self._placements:
            if self._points is None:
                check_device(config.resolve())
                views.train.check()
                check_cameras(views.train.cameras, config.resolve(), mesh=self._tree is not None)
                self._points = placement_points(views, config, self._tree)
            points, bark = self._points
            self._placements[kind] = find_placement(views.train, points, config.resolve(), effort=QUICK, bark=bark)
        return self._placements[kind]


def short_config(config: FitConfig, count: int, sides: Sides, placement: Placement, max_texels: int | None) -> FitConfig:
    """The options of a short fit of ``count`` billboards: those of ``config``, but a short search and few steps."""
    most = _MOST | ({} if placement == "even" else {"levels": _LEVELS})
    chosen = replace(config, billboards=count, sides=sides, placement=placement)
    full = chosen.resolve()  # the more billboards, the shorter its search
    short: dict[str, Any] = {name: min(value, getattr(full, name)) for name, value in most.items()}
    short["views_per_step"] = config.views_per_step or _VIEWS_PER_STEP
    return replace(chosen, max_texels=max_texels, **short)
