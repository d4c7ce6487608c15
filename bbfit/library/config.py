"""The options of a library."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

from bbfit.checks import Count, Range
from bbfit.exporting.config import LodConfig
from bbfit.workers.config import WorkersConfig


@dataclass(frozen=True)
class LibraryConfig(WorkersConfig, LodConfig):
    """The levels of detail of each tree, their atlas, and the processes or machines that make them."""

    planes: tuple[Count, ...] = (256, 64, 16, 4)
    """Number of billboards of each level, the finest first. The finest is what a visitor sees near by, unless the trees are kept."""
    original: bool = False
    """Keep the trees themselves as their finest levels. Their files contain their own textures."""
    page_size: Annotated[int, Range(64, 32768)] = 8192
    """Most texels along a side of the atlas. Where more are needed, there are several pictures.
    Most graphics cards read up to 16,384; phones read 4096."""

    def __post_init__(self) -> None:
        LodConfig.__post_init__(self)
        WorkersConfig.__post_init__(self)

    @property
    def levels(self) -> LodConfig:
        """The options of each tree's levels."""
        return LodConfig(**{field.name: getattr(self, field.name) for field in fields(LodConfig)})
