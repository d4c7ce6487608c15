"""Showing a fit on a page while it goes on, in the background and at most a small share of the time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from bbfit.blender.config import ViewsConfig
from bbfit.exporting.config import ExportConfig
from bbfit.fitting.loop import Step
from bbfit.geometry.alpha import AlphaKind, AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import premultiply, unpremultiply
from bbfit.viewing.background import Background
from bbfit.viewing.models import Look, Models
from bbfit.viewing.originals import MOST_BYTES, Original, find_original
from bbfit.viewing.subject import light_of, live_subject, open_run

if TYPE_CHECKING:
    from bbfit.viewing.page import Page

# Seconds between two pictures at least, and the share of the time that making them may take.
_EVERY, _SHARE = 2.0, 0.04
# Texels from which on a preview has halved textures.
_TEXELS = 200_000


class Watch:
    """Keeps a page up to date with a run; to be told of its steps and stages."""

    def __init__(self, page: Page, out: str | Path, source: str | Path | None, tree: str | Path | None, alpha: AlphaKind) -> None:
        """
        Parameters
        ----------
        out : the run's folder.
        source : what the run is of: a tree, a folder of views, or ``None`` if a tree is grown.
        tree : the mesh that a folder of views shows, if it is known.
        alpha : the alpha mode that is fitted for.
        """
        self._page, self._out, self._alpha = page, Path(out), alpha
        folder = source is not None and Path(source).is_dir()
        self._tree = Path(tree) if tree is not None else None if folder else Path(source) if source is not None else self._out / "tree.glb"
        self._views = Path(source) if folder and source is not None else self._out / "views"
        self._found: tuple[Original, ViewsConfig] | None = None
        self._next, self._busy, self._spent = 0.0, False, 0.0
        self._background = Background()

    @property
    def spent(self) -> float:
        """Seconds that the pictures took in all, most of them beside the fit."""
        return self._spent

    def on_progress(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Say how far a stage is (:class:`bbfit.pipeline.Progress`)."""
        if stage != "fit":  # whose steps are told with the picture
            self._page.say(f"{stage} {done}/{total} {note}".rstrip())

    def on_step(self, step: Step) -> None:
        """Show the billboards as they are after a step, unless the last picture is too recent or still being made."""
        if self._busy or (time.monotonic() < self._next and step.index < step.total):
            return
        self._busy = True
        begun = time.monotonic()
        cloud = step.snapshot()
        self._background.start(lambda: self._show(cloud, step.index, step.total, step.loss, begun))

    def finish(self) -> None:
        """Show the finished run, with all that a page has."""
        self.close()
        self._page.say("")
        self._page.show(open_run(self._out))

    def close(self) -> None:
        """Make no more pictures, and wait for the one that is being made."""
        self._background.close()

    def _show(self, cloud: BillboardCloud, index: int, total: int, loss: float, begun: float) -> None:
        try:
            if self._found is None:
                self._found = find_original([self._tree], MOST_BYTES), light_of(self._views)
            subject = live_subject(preview(cloud, self._alpha), self._out.resolve().name, *self._found)
            models = Models(ExportConfig())
            models.make(subject.clouds[0], Look(self._alpha))
            self._page.say(f"fitting: step {index:,} of {total:,}, loss {loss:.5f}")
            self._page.show(subject, models)
        finally:
            took = time.monotonic() - begun
            self._spent += took
            self._next, self._busy = time.monotonic() + max(_EVERY, took / _SHARE), False


def preview(cloud: BillboardCloud, alpha: AlphaKind) -> BillboardCloud:
    """A cloud with an alpha mode, and with textures that are quick to pack: halved, by the mean of four texels, while there are many."""
    textures = [premultiply(texture.float()) for texture in cloud.textures()]
    while sum(len(texture.reshape(-1, 4)) for texture in textures) > _TEXELS:
        textures = [
            torch.nn.functional.avg_pool2d(texture.permute(0, 3, 1, 2), 2, ceil_mode=True).permute(0, 2, 3, 1) for texture in textures
        ]
    return BillboardCloud(
        centers=cloud.centers,
        rights=cloud.rights,
        ups=cloud.ups,
        half_extents=cloud.half_extents,
        texture_sizes=torch.tensor([texture.shape[1:3] for texture in textures]),
        two_sided=cloud.two_sided,
        texels=torch.cat([unpremultiply(texture).reshape(-1, 4) for texture in textures]),
        alpha=AlphaMode(alpha, cloud.alpha.cutoff),
    )
