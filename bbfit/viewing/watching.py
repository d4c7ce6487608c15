"""Showing a fit in the viewer while it runs, in the background and for at most a small share of the time."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from bbfit.exporting.config import ExportConfig
from bbfit.fitting.loop import Step
from bbfit.geometry.alpha import AlphaKind, AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.images import premultiply, unpremultiply
from bbfit.viewing.models import ModelCache, ModelOptions
from bbfit.viewing.originals import Original, find_original
from bbfit.viewing.server import Viewer
from bbfit.viewing.viewed import SeenColor, light_of, live_tree, open_results, seen_colors


@dataclass(frozen=True)
class WatchedRun:
    """A run that is watched."""

    out: Path
    """The run's folder."""
    source: Path | None
    """The run's source: a tree, a folder of views, or ``None`` if a tree is grown."""
    tree: Path | None
    """The mesh that a folder of views shows, if it is known."""
    alpha: AlphaKind
    """The alpha mode of the fit."""


class Watch:
    """Keeps a viewer up to date with a run; the viewer stays open when the watch ends.

    At least ``interval`` seconds pass between two previews, which may take at most the fraction ``share`` of the time.
    """

    def __init__(self, viewer: Viewer, run: WatchedRun, *, interval: float = 2.0, share: float = 0.04) -> None:
        self._viewer, self._run, self._interval, self._share = viewer, run, interval, share
        self._origin: tuple[Original, Light, tuple[SeenColor, ...]] | None = None
        self._thread: threading.Thread | None = None
        self._next, self._spent = 0.0, 0.0

    @property
    def spent(self) -> float:
        """Seconds that previews have taken, most of them in parallel with the fit."""
        return self._spent

    def on_progress(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show how far a stage is (:class:`bbfit.stages.stage.OnProgress`)."""
        if stage != "fit":  # each preview reports the step of the fit
            self._viewer.show_status(f"{stage} {done}/{total} {note}".rstrip())

    def on_step(self, step: Step) -> None:
        """Show the billboards after a step of the fit, unless the last preview is too recent or not finished yet."""
        is_busy = self._thread is not None and self._thread.is_alive()
        if is_busy or (time.monotonic() < self._next and step.index < step.total):
            return
        self._thread = threading.Thread(target=self._show, args=(step.snapshot(), step, time.monotonic()), daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Show the finished run."""
        self.close()
        self._viewer.show_status("")
        self._viewer.show(open_results(self._run.out))

    def close(self) -> None:
        """Wait for the preview that is being made."""
        if self._thread is not None:
            self._thread.join()

    def _show(self, cloud: BillboardCloud, step: Step, begun: float) -> None:
        if self._origin is None:
            self._origin = _origin(self._run)
        tree = live_tree(preview(cloud, self._run.alpha), self._run.out.resolve().name, *self._origin)
        models = ModelCache(tree.clouds, ExportConfig())
        models.glb(0, ModelOptions(self._run.alpha))
        self._viewer.show_status(f"fitting: step {step.index:,} of {step.total:,}, loss {step.loss:.5f}")
        self._viewer.show(tree, models)
        took = time.monotonic() - begun
        self._spent += took
        self._next = time.monotonic() + max(self._interval, took / self._share)


def _origin(run: WatchedRun) -> tuple[Original, Light, tuple[SeenColor, ...]]:
    """The original of a run, its light and its colors in views."""
    if run.source is not None and run.source.is_dir():
        return find_original([run.tree]), light_of(run.source), seen_colors(run.source)
    views = run.out / "views"
    return find_original([run.tree or run.source or run.out / "tree.glb"]), light_of(views), seen_colors(views)


def preview(cloud: BillboardCloud, alpha: AlphaKind, *, max_texels: int = 200_000) -> BillboardCloud:
    """A cloud with an alpha mode and with textures that are quick to pack.

    The textures are halved, by the mean of four texels, until there are at most ``max_texels``.
    """
    textures = [premultiply(texture.float()) for texture in cloud.textures()]
    while sum(len(texture.reshape(-1, 4)) for texture in textures) > max_texels:
        textures = [
            torch.nn.functional.avg_pool2d(texture.permute(0, 3, 1, 2), 2, ceil_mode=True).permute(0, 2, 3, 1) for texture in textures
        ]
    sizes = torch.tensor([texture.shape[1:3] for texture in textures])
    texels = torch.cat([unpremultiply(texture).reshape(-1, 4) for texture in textures])
    return replace(cloud, texture_sizes=sizes, texels=texels, alpha=AlphaMode(alpha, cloud.alpha.cutoff))
