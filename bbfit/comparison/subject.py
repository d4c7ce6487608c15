"""What the systems of a comparison work on, and what they return."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from bbfit.comparison.config import CompareConfig
from bbfit.evaluation.light import LightScore
from bbfit.evaluation.scoring import score_model_light
from bbfit.exporting.model import ShippedModel
from bbfit.files import read_json, write_json
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.camera import Camera
from bbfit.inputs import reading
from bbfit.pipeline import RunConfig
from bbfit.rendering.cards import CardRenderer
from bbfit.reporting.comparison_tables import CompareRow
from bbfit.rivals.baking import BakeConfig
from bbfit.stages.stage import OnProgress
from bbfit.tree_files.tree_file import TreeFile
from bbfit.views.dataset import ViewDataset

Baked = TypeVar("Baked")


def is_missing(note: str) -> bool:
    """Whether the note of a system says that a package or a library is missing, without which the system is left out."""
    return "is not installed" in note or "LLVM" in note


@dataclass(frozen=True)
class Subject:
    """A tree with its views, and the options of the comparison."""

    tree: TreeFile
    """The tree, in a format that all systems read."""
    views: ViewDataset
    """Its views; a system sees the training split only."""
    folder: Path
    """The folder of the comparison, which contains ``views``."""
    config: CompareConfig
    """The sizes of the systems."""
    stages: RunConfig
    """The options of views, and those that all fits and exports share."""
    on_progress: OnProgress
    """Called with the progress of each system."""
    row: Callable[[str], CompareRow]
    """The row of another system, by its name."""

    @property
    def bake(self) -> BakeConfig:
        """How rivals bake: with the resolution and the light of the views."""
        return BakeConfig(float(pixels_per_meter(self.views.train.cameras)), views=self.stages.views)

    @property
    def most_bytes(self) -> int:
        """The size of the ``bbfit`` system's model, which others may not exceed."""
        size = self.row("bbfit").costs.bytes
        assert size is not None
        return size

    def on(self, folder: Path, activity: str) -> Callable[[int, int], None]:
        """Reports the progress of a system with the given folder."""
        return partial(self.on_progress, f"{folder.name} {activity}")


@dataclass(frozen=True)
class SystemResult:
    """The simplified tree of a system."""

    model: bytes | None
    """The GLB file. ``None`` if there is none."""
    vertices: int | None
    """Vertices of the model."""
    seconds: float
    """Time of making it."""
    draw: Callable[[Camera], Tensor] | None
    """Draws what the camera of a held-out view sees, or the same camera with a smaller picture, as premultiplied RGBA. ``None`` if the
    result looks like the tree itself."""
    planes: int | None = None
    """Number of planes; ``None`` for a mesh."""
    note: str = ""
    """A remark for the reader."""
    size: int | None = None
    """Size in bytes if there is no GLB file."""
    fragments: Callable[[Camera], float] | None = None
    """Fragments that a graphics card shades for one camera. ``None`` if that is not known."""
    triangles: int | None = None
    """Triangles that are drawn for a picture, if not all of the model's."""
    shader: bool = False
    """Whether a program needs a shader or a decoder of its own to show it."""
    lit: Callable[[Callable[[int, int], None]], LightScore | None] | None = None
    """Scores it under the suns of held-out views, and reports finished views and their total. ``None`` if that is not done."""


@dataclass(frozen=True)
class System:
    """A way to simplify a tree."""

    title: str
    """What it does, for the reader."""
    simplify: Callable[[Subject, Path], SystemResult]
    """Simplifies the tree, with a folder for its files."""
    inputs: tuple[Any, ...] = ()
    """What the result depends on besides the tree, its views, and the options that all fits and exports share."""


def baking(folder: Path, bake: Callable[[], Baked]) -> tuple[Baked, float]:
    """What ``bake`` makes from pictures in a folder, and its seconds.

    ``seconds.json`` there keeps them. Those of an interrupted bake count, and a later one that finds all pictures adds none.
    """
    path, seconds, known = folder / "seconds.json", 0.0, False
    if path.is_file():
        content = read_json("seconds", path)
        with reading("seconds", path, "remove it"):
            seconds, known = float(content["seconds"]), bool(content["finished"])
    started, finished = time.perf_counter(), False
    try:
        baked, finished = bake(), True
    finally:
        if not known and folder.is_dir():
            seconds += time.perf_counter() - started
            write_json(path, {"seconds": seconds, "finished": finished})
    return baked, seconds


def billboards(subject: Subject, model: ShippedModel, seconds: float) -> SystemResult:
    """The result of a system that takes ``seconds`` to make billboards, and some more for their file. Masks are drawn with alpha to
    coverage.
    """
    started, cloud = time.perf_counter(), model.cloud
    drawn = model.antialiased() if cloud.alpha.kind == "mask" else model
    glb = model.glb
    return SystemResult(
        glb,
        model.cards.vertex_count,
        seconds + time.perf_counter() - started,
        drawn.draw,
        len(cloud),
        "drawn with alpha to coverage" if cloud.alpha.tested else "",
        fragments=CardRenderer(model.cards).fragments,
        lit=partial(_lit, subject, model),
    )


def _lit(subject: Subject, model: ShippedModel, on_view: Callable[[int, int], None]) -> LightScore | None:
    views, baked = subject.views.lit_test, subject.views.test.light
    return None if views is None or baked is None else score_model_light(model, views, baked[[0]], on_view)
