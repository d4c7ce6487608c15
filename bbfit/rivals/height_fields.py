"""A tree coded as height fields over many planes: how few bytes its geometry takes in a code of its own.

After Ochotta and Saupe 2004, "Compression of Point-Based 3D Models by Shape-Adaptive Wavelet Coding of Multi-Height Fields": a surface is
parted into patches (``surface_patches``), and each patch is resampled on a grid as heights over a plane (``patch_grid``). Shape-adaptive
wavelets code the heights (``shape_wavelets``), and the outlines of patches are coded without loss. Ours: triangles are parted, not points;
heights are rounded before reversible wavelets, where the paper codes bit planes with an optimal allocation; LZMA packs all numbers. Each
patch has one material of the tree, without its textures.
"""

from __future__ import annotations

import io
import lzma
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_range
from bbfit.images import srgb_to_linear
from bbfit.rivals.mesh_parts import Part, parts_glb, tree_parts, used_vertices
from bbfit.rivals.patch_grid import LEVELS, Floats, Integers, PatchGrid
from bbfit.rivals.shape_wavelets import band_of, restored, transformed
from bbfit.rivals.surface_patches import halved, linked, surface_patches
from bbfit.tree_files.gltf_materials import with_transmission
from bbfit.tree_files.tree_file import TreeFile

STEPS = 4
"""Steps of height to the width of a cell."""
# Surfaces that lie over each other by this many cells in one cell are no height field; rounds of cutting such patches.
_SPAN, _ROUNDS = 3.0, 5
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME}]


@dataclass(frozen=True)
class HeightFields:
    """A coded tree."""

    data: bytes
    """The code: planes, outlines, heights and the number of each patch's material."""
    patches: int
    """Number of height fields."""
    samples: int
    """Heights of all patches together."""
    error: float
    """Root mean square of the tree's distance from the decoded heights, along the planes' normals, in meters. Where the surface is beyond
    the outline of its patch, it counts with the width of a cell."""
    glb: bytes
    """The decoded tree as a GLB file, two triangles for each sample."""


def height_fields(tree: str | Path | TreeFile, spacing: float) -> HeightFields:
    """Code the geometry of a .glb, .gltf or .obj with cells ``spacing`` meters wide, and decode it.

    Heights are rounded to a quarter of the width of a cell. Raises ``MissingFileError`` or ``InputError`` if the file cannot be used or the
    spacing is not positive.
    """
    check_range("spacing", spacing, 0, float("inf"), open_low=True, open_high=True)
    tree = TreeFile.open(tree)
    parts = tree_parts(tree)
    triangles = np.concatenate([part.points[part.faces] for part in parts])
    materials = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    counts = np.cumsum([0] + [len(part.points) for part in parts])
    links = linked(np.concatenate([part.faces + first for part, first in zip(parts, counts, strict=False)]))
    patches = surface_patches(triangles, links)
    for left in reversed(range(_ROUNDS)):
        patches = _ordered(triangles, patches)
        grid = PatchGrid.around(triangles, patches, spacing)
        low, high, heights, filled = _resampled(triangles, patches, grid)
        folded = np.zeros(len(grid.sizes), bool)
        folded[grid.owners[high - low > _SPAN * spacing]] = True
        if not left or not folded.any():
            break
        patches = halved(triangles, patches, folded, links)
    levels = np.rint(heights * STEPS / spacing).astype(np.int64)
    owners = np.zeros(len(grid.sizes), np.int64)
    owners[patches] = materials
    data = _code(grid, owners, filled, levels)
    error = _error(triangles, patches, grid, filled, levels * spacing / STEPS)
    plain = [_plain(part) for part in parts]
    same = {part.material.name for part, material in zip(parts, plain, strict=True) if material is not None and material is part.material}
    glb = with_transmission(parts_glb(decoded(data, plain)), tree, colors=same, textures=False)
    return HeightFields(data, len(grid.sizes), int(filled.sum()), error, glb)


def decoded(data: bytes, materials: list[Any]) -> list[Part]:
    """The surface of a code: the triangles of each material, of which the code contains the numbers."""
    stream = io.BytesIO(data)
    (spacing,) = struct.unpack("<d", stream.read(8))
    corners = np.cumsum(np.stack([_unpacked(stream) for _ in range(3)], -1), 0)
    turns, sizes = (np.stack([_unpacked(stream) for _ in range(count)], -1) for count in (3, 2))
    owners = _unpacked(stream)
    grid = PatchGrid(spacing, corners, turns, sizes)
    filled = np.unpackbits(_unpacked(stream).astype(np.uint8))[: grid.starts[-1]].astype(bool)
    sheet, size = grid.sheet()
    rows, columns = sheet[filled].T
    bands, coefficients, mask = band_of(*size, LEVELS)[rows, columns], np.zeros(size, np.int32), np.zeros(size, bool)
    for band in range(LEVELS + 1):
        chosen = bands == band
        coefficients[rows[chosen], columns[chosen]] = _unpacked(stream)
    mask[rows, columns] = True
    heights = restored(coefficients, mask, LEVELS)[rows, columns] * spacing / STEPS
    points, faces, cells = _surface(grid, filled, heights)
    of_face = np.repeat(owners[cells], 2)
    parts = [Part(points, faces[of_face == index], None, material) for index, material in enumerate(materials)]
    return [used_vertices(part) for part in parts if len(part.faces)]


def _ordered(triangles: Floats, patches: Integers) -> Integers:
    """The same patches, numbered along a Morton curve, on which neighbors in space are mostly neighbors."""
    middles = np.stack([np.bincount(patches, triangles[:, :, axis].mean(1)) for axis in range(3)], -1) / np.bincount(patches)[:, None]
    low = middles.min(0)
    cells = ((middles - low) / (np.ptp(middles, axis=0).max() + 1e-30) * 1023).astype(np.int64)
    keys = sum(((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for axis in range(3) for bit in range(10))
    numbers = np.empty(len(middles), np.int64)
    numbers[np.argsort(keys, kind="stable")] = np.arange(len(middles))
    return numbers[patches]


def _resampled(triangles: Floats, patches: Integers, grid: PatchGrid) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Lowest, highest and mean height over each cell in meters, [C], and whether the surface fills it.

    A cell is filled if the surface covers half of it. If a surface is thinner than a cell, half of its widest part is enough.
    """
    count = int(grid.starts[-1])
    low, high, total, area = np.full(count, np.inf), np.full(count, -np.inf), np.zeros(count), np.zeros(count)
    for cells, heights, areas in grid.samples(triangles, patches):
        np.minimum.at(low, cells, heights)
        np.maximum.at(high, cells, heights)
        total += np.bincount(cells, heights * areas, count)
        area += np.bincount(cells, areas, count)
    share = area / grid.spacing**2
    enough = np.minimum(np.maximum.reduceat(share, grid.starts[:-1]), 1)[grid.owners] / 2
    return low, high, total / np.maximum(area, 1e-30), share >= enough


def _error(triangles: Floats, patches: Integers, grid: PatchGrid, filled: NDArray[np.bool_], heights: Floats) -> float:
    squares = whole = 0.0
    for cells, exact, areas in grid.samples(triangles, patches):
        apart = np.where(filled[cells], exact - heights[cells], grid.spacing)
        squares, whole = squares + float((areas * apart**2).sum()), whole + float(areas.sum())
    return float(np.sqrt(squares / whole))


def _code(grid: PatchGrid, owners: Integers, filled: NDArray[np.bool_], levels: Integers) -> bytes:
    steps = np.diff(grid.corners, axis=0, prepend=0)
    sheet, size = grid.sheet()
    rows, columns = sheet[filled].T
    picture, mask = np.zeros(size, np.int32), np.zeros(size, bool)
    picture[rows, columns], mask[rows, columns] = levels[filled], True
    coefficients, bands = transformed(picture, mask, LEVELS)[rows, columns], band_of(*size, LEVELS)[rows, columns]
    numbers = [*steps.T, *grid.turns.T, *grid.sizes.T, owners, np.packbits(filled)]
    numbers += [coefficients[bands == band] for band in range(LEVELS + 1)]
    return struct.pack("<d", grid.spacing) + b"".join(_packed(each) for each in numbers)


def _packed(numbers: Integers) -> bytes:
    """Whole numbers in bytes: signs last, the bytes of each place together, packed by LZMA."""
    unsigned = np.where(numbers < 0, -2 * numbers.astype(np.int64) - 1, 2 * numbers.astype(np.int64)).astype("<u8")
    planes = unsigned.view(np.uint8).reshape(-1, 8).T
    used = int(np.nonzero(planes.any(1))[0].max(initial=-1)) + 1
    data = lzma.compress(planes[:used].tobytes(), lzma.FORMAT_RAW, filters=_FILTERS)
    return struct.pack("<BII", used, len(unsigned), len(data)) + data


def _unpacked(stream: io.BytesIO) -> Integers:
    used, count, size = struct.unpack("<BII", stream.read(9))
    planes = np.zeros((8, count), np.uint8)
    data = lzma.decompress(stream.read(size), lzma.FORMAT_RAW, filters=_FILTERS)
    planes[:used] = np.frombuffer(data, np.uint8).reshape(used, count)
    unsigned = np.ascontiguousarray(planes.T).view("<u8")[:, 0].astype(np.int64)
    return np.where(unsigned & 1, -(unsigned >> 1) - 1, unsigned >> 1)


def _surface(grid: PatchGrid, filled: NDArray[np.bool_], heights: Floats) -> tuple[Floats, Integers, Integers]:
    """Vertices [V, 3], two triangles for each filled cell [2 S, 3], and the patch of each filled cell [S]."""
    owners, places = grid.owners[filled], grid.places[filled]
    corners = places[:, None] + np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
    width = int(grid.sizes[:, 1].max()) + 1
    first = np.concatenate([[0], np.cumsum((grid.sizes[:, 0] + 1) * width)])
    keys, vertices = np.unique(first[owners][:, None] + corners[..., 0] * width + corners[..., 1], return_inverse=True)
    vertices = vertices.reshape(-1, 4)
    height = np.bincount(vertices.ravel(), np.repeat(heights, 4)) / np.bincount(vertices.ravel())
    patch = np.searchsorted(first, keys, side="right") - 1
    row, column = np.divmod(keys - first[patch], width)
    local = np.stack([column * grid.spacing, row * grid.spacing, height], -1)
    points = np.einsum("va,vax->vx", local, grid.axes[patch]) + grid.corners[patch] * grid.spacing
    return points, vertices[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), owners


def _plain(part: Part) -> Any:
    """The material of a part with the mean linear color of its texture or of its vertices in their place."""
    from trimesh.visual.material import PBRMaterial

    if part.colors is not None:
        return PBRMaterial(baseColorFactor=np.rint(part.colors.mean(0)).astype(np.uint8), metallicFactor=0.0, doubleSided=True)
    material = part.material
    picture = getattr(material, "baseColorTexture", None)
    if picture is None:
        return material
    texels = np.asarray(picture.convert("RGBA")).reshape(-1, 4) / 255
    seen = np.ones(len(texels)) if material.alphaMode in (None, "OPAQUE") else texels[:, 3] + 1e-9
    mean = seen @ srgb_to_linear(texels[:, :3]) / seen.sum()
    factor = np.ones(3) if material.baseColorFactor is None else np.asarray(material.baseColorFactor)[:3] / 255
    plain = material.copy()
    for name in ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture"):
        setattr(plain, name, None)
    plain.alphaMode, plain.baseColorFactor = None, np.append(np.rint(255 * mean * factor), 255).astype(np.uint8)
    return plain
