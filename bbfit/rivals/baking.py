"""Billboards whose textures are parallel renders of slabs of a tree."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.blender.config import ViewsConfig
from bbfit.blender.conversion import tree_as_glb
from bbfit.blender.pictures import FILTER_REACH, render_pictures
from bbfit.checks import check_range, check_shape, fail
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, orthographic_intrinsics
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import bleed_color, read_rgba
from bbfit.inputs import InputLimits
from bbfit.scratch import ScratchFolder
from bbfit.tree_files.tree_file import Y_UP_MESHES, TreeFile

# What of the light from all around the inside of a stem reflects at most. In uncut pictures of an acer and an aspen nothing is as dark,
# in those of a willow one texel in ten thousand.
_INSIDE = 0.03
_LIMITS = InputLimits()
_TENSORS = ("centers", "rights", "ups", "half_extents", "depths")


@dataclass(frozen=True)
class BakeConfig:
    """Resolution and lighting of the baked textures."""

    texels_per_meter: float
    """Texels per meter along the sides of every rectangle."""
    two_sided: bool = False
    """Whether a rectangle has a back texture, rendered from behind; otherwise both sides show the front's texture."""
    alpha: AlphaMode = field(default_factory=AlphaMode)
    """Alpha mode of the cloud."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """Light, samples, denoising, device, workers and seed, which should equal those of the compared views; other options are not used."""

    def __post_init__(self) -> None:
        check_range("texels_per_meter", self.texels_per_meter, 0, math.inf, open_low=True)


@dataclass(frozen=True)
class Slabs:
    """N rectangles, and the range of distances from their planes that each one shows."""

    centers: Tensor
    """Rectangle centers in meters, [N, 3] float64."""
    rights: Tensor
    """Unit vectors to the right, seen from the front, [N, 3]."""
    ups: Tensor
    """Unit vectors upwards, perpendicular to ``rights``, [N, 3]."""
    half_extents: Tensor
    """Half width and half height in meters, [N, 2]."""
    depths: Tensor
    """Smallest and largest signed distance from the plane that is shown, along the normal ``right x up``, in meters, [N, 2]."""

    def __post_init__(self) -> None:
        n = len(self.centers)
        for name, width in zip(_TENSORS, (3, 3, 3, 2, 2), strict=True):
            check_shape(name, tuple(getattr(self, name).shape), (n, width))
        if not (self.depths[:, 0] < self.depths[:, 1]).all():
            fail("depths", f"expected the least before the greatest, got {self.depths.tolist()}")

    def __len__(self) -> int:
        return len(self.centers)

    @staticmethod
    def joined(parts: Sequence[Slabs]) -> Slabs:
        """Concatenate slabs."""
        return Slabs(*(torch.cat([getattr(part, name) for part in parts]) for name in _TENSORS))


def bake(
    tree: str | Path | TreeFile,
    slabs: Slabs,
    config: BakeConfig,
    *,
    fill_cuts: bool = False,
    folder: str | Path | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> BillboardCloud:
    """Render what lies within each slab onto its rectangle, in parallel projection along the normal.

    Pixels of the renders are texels of the textures. Rectangles are cropped to the visible part, in whole texels. Geometry outside a slab
    still casts shadows. Transparent texels take the color of the nearest visible texel, because filtering uses straight alpha.

    Parameters
    ----------
    tree, folder, on_progress
        As for :func:`~bbfit.blender.pictures.render_pictures`. Without a folder, an interrupted bake cannot resume.
    slabs
        N rectangles. They must contain everything that is to be visible; a margin for the renderer's filter is added.
    fill_cuts
        Give texels that show the dark inside of a stem, which the slab cuts open, the color of the nearest lit texel. A texel counts as
        inside if it reflects less than 3% of ``config.views.ambient_strength``, in sunlight or not.

    Returns
    -------
    BillboardCloud
        A float32 cloud in the order of the slabs, without empty ones.

    Raises
    ------
    MissingFileError, InputError, BlenderError
        As for ``render_pictures``, also if a picture would have more than 16384 texels a side.
    """
    if folder is None:
        with ScratchFolder() as scratch:
            return bake(tree, slabs, config, fill_cuts=fill_cuts, folder=scratch, on_progress=on_progress)
    if not len(slabs):
        fail("slabs", "there is none to bake")
    # Texels from a rectangle's center to its sides; the center lies on the corner of a texel.
    reach = _whole_texels(slabs.half_extents * config.texels_per_meter) + int(FILTER_REACH)
    size = 2 * int(reach.max())
    cameras, clips = _facing(slabs, size, config.texels_per_meter)
    if config.two_sided:
        back, behind = _facing(_turned(slabs), size, config.texels_per_meter)
        cameras = Camera.joined([cameras, back])
        clips += behind
    paths = render_pictures(tree, cameras, folder, config.views, clips=clips, on_progress=on_progress)
    count = len(slabs)
    parts: list[tuple[int, Tensor, Tensor]] = []
    for n in range(count):
        sides = [read_rgba(paths[n])]
        if config.two_sided:
            sides.append(read_rgba(paths[count + n])[:, ::-1])  # as seen from the front
        part = _cropped(np.stack(sides), *reach[n].tolist())
        if part is not None:
            dark = _displayed(_INSIDE * config.views.ambient_strength) if fill_cuts else 0.0
            parts.append((n, torch.stack([_bled(side, dark) for side in part[0]]), part[1]))
    return _assembled(slabs, parts, config)


def tree_triangles(tree: str | Path | TreeFile, limits: InputLimits = _LIMITS) -> NDArray[np.float64]:
    """Corners of all triangles of a tree in the world of its views, [T, 3, 3] in meters.

    Blender reads formats other than .glb, .gltf and .obj. The errors of :func:`~bbfit.blender.conversion.tree_as_glb` and
    :meth:`~bbfit.tree_files.tree_file.TreeFile.mesh` are raised.
    """
    tree = TreeFile.open(tree, limits)
    if tree.suffix not in Y_UP_MESHES:
        with ScratchFolder() as scratch:
            return tree_triangles(tree_as_glb(tree, scratch / "tree.glb"), limits)
    return np.asarray(tree.mesh().triangles, np.float64)


def _whole_texels(lengths: Tensor) -> Tensor:
    """Rounded up, int64; a rounding error above a whole number is ignored."""
    return (lengths - 1e-6).ceil().clamp_min(1).long()


def _turned(slabs: Slabs) -> Slabs:
    """The same rectangles from behind."""
    return Slabs(slabs.centers, -slabs.rights, slabs.ups, slabs.half_extents, -slabs.depths.flip(-1))


def _facing(slabs: Slabs, size: int, texels_per_meter: float) -> tuple[Camera, list[tuple[float, float]]]:
    """Parallel cameras in front of rectangles, with square pictures about their centers, and clip distances of the slabs."""
    slabs = Slabs(*(getattr(slabs, name).double() for name in _TENSORS))
    normals = torch.linalg.cross(slabs.rights, slabs.ups)
    rotation = torch.stack([slabs.rights, -slabs.ups, -normals], -2)
    distance = slabs.depths[:, 1] + size / texels_per_meter  # of the camera from the plane: far enough for a nearest distance above 0
    transform = torch.eye(4, dtype=torch.float64).repeat(len(slabs), 1, 1)
    transform[:, :3, :3] = rotation
    transform[:, :3, 3:] = -(rotation @ (slabs.centers + distance[:, None] * normals)[..., None])
    intrinsics = orthographic_intrinsics(size / texels_per_meter, size, size).repeat(len(slabs), 1, 1)
    near, far = distance - slabs.depths[:, 1], distance - slabs.depths[:, 0]
    return Camera(transform, intrinsics, size, size, True), list(zip(near.tolist(), far.tolist(), strict=True))


def _cropped(sides: NDArray[np.uint8], across: int, along: int) -> tuple[Tensor, Tensor] | None:
    """The visible part of pictures [S, size, size, 4], at most ``across`` and ``along`` texels from their middle, [S, h, w, 4].

    Also returns its left, right, top and bottom edges in texels from the middle, [4]. None if nothing is visible.
    """
    middle = sides.shape[1] // 2
    part = sides[:, middle - along : middle + along, middle - across : middle + across]
    rows, columns = (np.nonzero((part[..., 3] > 0).any(axes))[0] for axes in ((0, 2), (0, 1)))
    if not len(rows):
        return None
    left, right, top, bottom = columns[0], columns[-1] + 1, rows[0], rows[-1] + 1
    texture = torch.from_numpy(np.ascontiguousarray(part[:, top:bottom, left:right]))
    edges = torch.tensor([left - across, right - across, top - along, bottom - along], dtype=torch.float64)
    return texture, edges


def _displayed(linear: float) -> float:
    """A linear value in [0, 1] as sRGB (IEC 61966-2-1), 0..255."""
    return 255 * (12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055)


def _bled(texture: Tensor, dark: float) -> Tensor:
    """A texture [h, w, 4], uint8, whose transparent texels, and visible ones below ``dark``, take the color of the nearest other texel."""
    lit = texture[..., :3].amax(-1) >= dark
    if not (lit & (texture[..., 3] > 0)).any():
        return bleed_color(texture)
    bled = bleed_color(torch.where(lit[..., None], texture, 0))
    return torch.cat([bled[..., :3], texture[..., 3:]], -1)


def _assembled(slabs: Slabs, shown: list[tuple[int, Tensor, Tensor]], config: BakeConfig) -> BillboardCloud:
    kept = [n for n, _, _ in shown]
    rights, ups = slabs.rights[kept], slabs.ups[kept]
    edges = torch.stack([edges for _, _, edges in shown]) if shown else torch.zeros(0, 4, dtype=torch.float64)
    left, right, top, bottom = (edges / config.texels_per_meter).split(1, -1)
    centers = slabs.centers[kept] + (left + right) / 2 * rights - (top + bottom) / 2 * ups
    sizes = [list(texture.shape[1:3]) for _, texture, _ in shown]
    texels = [texture.reshape(-1, 4) for _, texture, _ in shown]
    return BillboardCloud(
        centers.float(),
        rights.float(),
        ups.float(),
        torch.cat([right - left, bottom - top], -1).float() / 2,
        torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2),
        torch.full((len(shown),), config.two_sided),
        torch.cat([*texels, torch.zeros(0, 4, dtype=torch.uint8)]).float() / 255,
        config.alpha,
    )
