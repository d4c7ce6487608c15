"""The triangles of a grown tree by material, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Material:
    """A plain surface: color, roughness and the light that passes through, no texture."""

    name: str
    """Name in the file, such as ``bark`` or ``leaf_0``."""
    color: tuple[float, float, float]
    """Linear RGB reflectance in [0, 1], as glTF's ``baseColorFactor``."""
    roughness: float
    """Roughness in [0, 1], as glTF's ``roughnessFactor``."""
    double_sided: bool
    """Whether the back of a triangle is visible, with its normal reversed, as for leaves."""
    transmission: float = 0.0
    """Share in [0, 1] of the light below the gloss that passes through, as glTF's ``diffuseTransmissionFactor``; the rest is reflected."""
    transmission_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear RGB in [0, 1], as glTF's ``diffuseTransmissionColorFactor``: the surface transmits ``transmission`` of it."""


@dataclass(frozen=True)
class Part:
    """The triangles of one material; Y up, meters, the foot of the trunk at the origin."""

    material: Material
    vertices: NDArray[np.float32]
    """Positions, [n, 3]."""
    normals: NDArray[np.float32]
    """Unit normals, [n, 3], on the side from which a triangle's corners run counter-clockwise."""
    uvs: NDArray[np.float32]
    """Texture coordinates, [n, 2], v counted upwards."""
    faces: NDArray[np.int32]
    """Corners of the triangles, [m, 3], as indices into the part's own vertices."""
