"""The models that a page sends to browsers, each made once."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaKind
from bbfit.viewing.levels import Level


@dataclass(frozen=True)
class Look:
    """How billboards are to be exported."""

    alpha: AlphaKind
    """What their alpha means."""
    split: bool = False
    """Whether they are cut up so that the page blends them in the right order."""


Key = tuple[int, int, Look]
"""Billboards, halvings of their textures, and how they are exported."""


@dataclass(frozen=True)
class Model:
    """A model file of billboards."""

    glb: bytes
    """The GLB file."""
    vertices: int
    """Its vertices."""


class Models:
    """The models of one subject, made when they are first asked for; safe to use from several threads."""

    def __init__(self, export: ExportConfig) -> None:
        self._export = export
        self._made: dict[Key, Model] = {}
        self._locks: dict[Key, threading.Lock] = {}
        self._lock = threading.Lock()

    def made(self, level: Level, look: Look) -> Model | None:
        """The model if it is there already."""
        return self._made.get(model_key(level, look))

    def make(self, level: Level, look: Look) -> Model:
        """The model of a level's billboards as an export would write it, with PNG textures."""
        key = model_key(level, look)
        with self._lock:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            if key not in self._made:
                self._made[key] = _model(level, look, self._export)
            return self._made[key]


def model_key(level: Level, look: Look) -> Key:
    """What tells a model from all others."""
    return level.mark, level.halvings, look


def _model(level: Level, look: Look, export: ExportConfig) -> Model:
    assert level.cloud is not None, "the original is no model of ours"
    config = replace(export, alpha=look.alpha, split=look.split)
    model = shipped_model(level.cloud, config, level.halvings)
    return Model(model.glb, model.cards.vertex_count)
