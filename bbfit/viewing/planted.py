"""A field of trees in one visitor's scene: every tree is an instance of one of a few models, by its distance from the camera."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bbfit.viewing.field import Field
from bbfit.viewing.levels import Level, choose_levels
from bbfit.viewing.models import Model

if TYPE_CHECKING:
    import viser

_NUMBERS = itertools.count()


class Planted:
    """The instances of a field."""

    def __init__(self, client: viser.ClientHandle, root: str, field: Field, levels: Sequence[Level], models: Sequence[Model]) -> None:
        self._client, self._field, self._levels, self._models = client, field, levels, models
        self._root = f"{root}/{next(_NUMBERS)}"
        self._nodes: dict[int, viser.BatchedGlbHandle] = {}
        self.counts = [0] * len(levels)
        """How many trees each level shows."""

    def __len__(self) -> int:
        return len(self._field)

    @property
    def vertices(self) -> int:
        """Vertices of all trees."""
        return sum(count * model.vertices for count, model in zip(self.counts, self._models, strict=True))

    def share_out(self, eye: NDArray[np.float64], focal: float) -> None:
        """Give every tree the level for its distance from the camera.

        Parameters
        ----------
        eye : the camera's place in meters, [3].
        focal : its focal length in pixels.
        """
        field = self._field
        away = np.linalg.norm(field.positions - eye, axis=-1)
        chosen = choose_levels(self._levels, focal * field.scales / np.maximum(away, 1e-6))
        with self._client.atomic():
            for index, model in enumerate(self._models):
                those = chosen == index
                self.counts[index] = int(those.sum())
                self._set(index, model, those)

    def _set(self, index: int, model: Model, those: NDArray[np.bool_]) -> None:
        field, node = self._field, self._nodes.get(index)
        if not those.any():
            if node is not None:
                node.visible = False
        elif node is None:
            self._nodes[index] = self._client.scene.add_batched_glb(
                f"{self._root}/{index}",
                model.glb,
                field.wxyzs[those],
                field.positions[those],
                batched_scales=field.scales[those],
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
        else:
            node.batched_wxyzs, node.batched_positions, node.batched_scales = (
                field.wxyzs[those],
                field.positions[those],
                field.scales[those],
            )
            node.visible = True

    def remove(self) -> None:
        """Take the trees away."""
        for node in self._nodes.values():
            node.remove()
        self._nodes.clear()
