"""The GLB files that the viewer sends to browsers."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaKind
from bbfit.geometry.cloud import BillboardCloud


@dataclass(frozen=True)
class ModelOptions:
    """How billboards are exported for the viewer."""

    alpha: AlphaKind
    """Alpha mode of the model."""
    split: bool = False
    """Whether billboards that cross are cut up, so that they can be sorted."""
    halvings: int = 0
    """How many times the sides of the textures are halved."""


class ModelCache:
    """The models of some clouds, each made when it is first requested, one at a time; safe to use from several threads."""

    def __init__(self, clouds: tuple[BillboardCloud, ...], export: ExportConfig) -> None:
        self._clouds, self._export = clouds, export
        self._models: dict[tuple[int, ModelOptions], bytes] = {}
        self._lock = threading.Lock()

    def glb(self, index: int, options: ModelOptions) -> bytes:
        """A cloud as an export would write it, with PNG textures. Raises IndexError if there is no such cloud."""
        key = index, options
        if key not in self._models:
            with self._lock:
                if key not in self._models:
                    config = replace(self._export, alpha=options.alpha, split=options.split)
                    self._models[key] = shipped_model(self._clouds[index], config, options.halvings).glb
        return self._models[key]

    def close(self, seconds: float = 60.0) -> None:
        """Wait for the model that is being made, at most for some seconds: a process must not exit in the middle of it."""
        if self._lock.acquire(timeout=seconds):
            self._lock.release()
