"""The options of measuring frame times."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from bbfit.checks import Count, Range, check_fields, fail
from bbfit.provenance import EXECUTION

Program = Literal["three", "babylon", "cycles"]
PACKAGES: dict[Program, tuple[str, ...]] = {"three": ("three",), "babylon": ("@babylonjs/core", "@babylonjs/loaders"), "cycles": ()}
"""The packages of npm that the page of each program needs."""


@dataclass(frozen=True)
class FramesConfig:
    """Which fields of trees are drawn, and in what."""

    tree_heights: tuple[Count, ...] = (400, 100, 30)
    """Heights of a tree in the picture, in pixels."""
    counts: tuple[Count, ...] = (100, 1_000, 10_000, 100_000)
    """Numbers of trees in the picture, from the least. A model is not drawn more often once a frame takes too long."""
    longest_ms: Annotated[float, Range(0, 600_000, open_low=True)] = 2000.0
    """Time of a frame in milliseconds after which larger numbers of trees are left out."""
    programs: tuple[Program, ...] = ("three", "babylon")
    """Programs that draw. cycles is Blender's renderer, whose pictures take seconds; it needs the extra blender."""
    cycles_counts: tuple[Count, ...] = (1, 100, 10_000)
    """Numbers of trees in the pictures of Cycles."""
    samples: Count = 16
    """Samples a pixel in the pictures of Cycles."""
    width: Count = 1280
    """Width of the picture in pixels."""
    height: Count = 720
    """Height of the picture in pixels."""
    elevation_degrees: Annotated[float, Range(0, 90, open_low=True)] = 15.0
    """Height of the camera above the horizon in degrees."""
    frames: Count = 7
    """Fewest frames of a median."""
    seconds: Annotated[float, Range(0, 600)] = 1.0
    """Least time in seconds that the frames of a median take together, if there are not many."""
    error_views: Count = 8
    """Most held-out views in which the error is measured at each height."""
    seed: Annotated[int, Range(0)] = 0
    """Seed of where the trees stand."""
    graphics_card: bool = field(default=False, metadata=EXECUTION)
    """Draw with the graphics card. Default: in software (SwiftShader), which is the same on all machines and hundreds of times slower."""
    node_modules: Path | None = field(default=None, metadata=EXECUTION)
    """Folder node_modules with the programs. Default: the nearest one, in this folder or above it."""
    browser: Path | None = field(default=None, metadata=EXECUTION)
    """Chromium's program. Default: the one on the path."""

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("tree_heights", "counts", "cycles_counts", "programs"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                fail(name, f"expected one or more different ones, got {list(values)}")
        if list(self.counts) != sorted(self.counts):
            fail("counts", f"expected rising numbers, got {list(self.counts)}", "list the least first")
