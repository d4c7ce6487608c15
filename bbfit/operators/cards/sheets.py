"""What the drawing of cards begins with: their textured planes, the levels of their atlas, and where cameras see the planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Card, Cards, texture_axes
from bbfit.geometry.polygons import area, sides
from bbfit.operators.cards.sampling import MipChain, joined
from bbfit.operators.drawing.reference import EDGE_ON

SLACK = 1e-9
"""Distance outside a polygon, as a share of the atlas, at which a pixel's center counts as inside, so that rounding opens no seams."""
CENTER = ((0.0, 0.0),)
"""The sample of a pixel without multisampling."""
SAMPLES = ((-2 / 16, -6 / 16), (6 / 16, -2 / 16), (-6 / 16, 2 / 16), (2 / 16, 6 / 16))
"""Four samples of a pixel, to the right of its center and below it, where graphics cards have them (Vulkan 1.3, section 25.1, standard
sample locations)."""
# Relative error of corners up to which a card belongs to a sheet.
_SAME = 1e-6


@dataclass(frozen=True)
class Sheets:
    """The S textured planes of cards, and their Q pieces: convex parts of a plane of which a ray meets at most one.

    Coordinates are float64. Corners and sides are padded to K by repetition.
    """

    to_world: Tensor
    """From (u, v, 1) to homogeneous world points, [S, 4, 3]."""
    normals: Tensor
    """[S, 3]."""
    centers: Tensor
    """Mean of the corners, [S, 3]."""
    axes: Tensor
    """Axes of the normals in a texture, in the world: right, up, and towards the visible side, [S, 3, 3]. NaN for cards without maps."""
    culled: Tensor
    """Whether only the front is drawn, bool [S]."""
    first: Tensor
    """Index of a texture's first texel among the texels of all textures, which seeds the mode ``hash``, int64 [S]."""
    of_piece: Tensor
    """The plane of each piece, int64 [Q], ascending. Pieces of a plane keep the order of the cards."""
    corners: Tensor
    """Homogeneous, [Q, K, 4]."""
    sides: Tensor
    """Coefficients (a, b, c) with a u + b v <= c inside, [Q, K, 3]."""

    def __len__(self) -> int:
        """The number S of planes."""
        return len(self.first)


@dataclass(frozen=True)
class PreparedCards:
    """Cards, with what does not depend on the camera."""

    cards: Cards
    sheets: Sheets
    """Their planes."""
    levels: MipChain
    """The levels of their atlas: colors and alpha, and the values of maps if there are any."""
    multisampled: bool
    """Whether a pixel has :data:`SAMPLES`, and not its center alone."""

    @cached_property
    def channels(self) -> tuple[Tensor, Tensor, Tensor]:
        """The texels of all levels: colors with alpha, normals with occlusion, and translucency in the first of four channels.

        uint8 [T, 4] each, or [0, 4] where there is none.
        """
        texels = self.levels.texels
        further = [texels[:, 4:8], torch.nn.functional.pad(texels[:, 8:], (0, 3))]
        color, normals, translucency = (part if part.shape[1] == 4 else part.new_empty(0, 4) for part in (texels[:, :4], *further))
        return color.contiguous(), normals.contiguous(), translucency


@dataclass(frozen=True)
class SeenSheets:
    """S sheets and their Q pieces in V cameras. Coordinates are float64."""

    to_uv: Tensor
    """From a pixel (x, y, 1) to homogeneous texture coordinates, [V, S, 3, 3]."""
    to_depth: Tensor
    """From (u, v, 1) to depth in meters, [V, S, 3]."""
    low: Tensor
    """The first column and row of the box around each piece, int64 [V, Q, 2]."""
    high: Tensor
    """The column and the row after the last, int64 [V, Q, 2]. Boxes of what is not shown are empty."""


def seen_sheets(sheets: Sheets, camera: Camera) -> SeenSheets:
    """What V cameras see of sheets, which neither shows what is edge-on nor culled sides."""
    camera = camera.batch().to("cpu").to(torch.float64)
    to_pixel = camera.world_to_pixel[:, None] @ sheets.to_world
    to_depth = (camera.world_to_camera[:, None, 2:3] @ sheets.to_world)[..., 0, :]
    distances, farthest = _distances(sheets, camera)
    shown = (distances.abs() > EDGE_ON * farthest) & ((distances > 0) | ~sheets.culled)
    # [u, v, 1] / depth for a pinhole, [u, v, 1] for parallel projection, from a pixel [x, y, 1]
    to_uv = torch.linalg.inv(torch.where(shown[..., None, None], to_pixel, torch.eye(3).double()))
    return SeenSheets(to_uv, to_depth, *_boxes(sheets, camera, shown))


def prepared_cards(cards: Cards, *, multisampled: bool | None = None) -> PreparedCards:
    """Prepare cards for drawing; ``multisampled`` is by default what their alpha mode says.

    Raises InputError if a level is not uint8 or not half as large as the level before, rounded down.
    """
    return PreparedCards(cards, sheets_of(cards), _levels(cards), cards.alpha.multisampled if multisampled is None else multisampled)


def _levels(cards: Cards) -> MipChain:
    """The levels of the atlas; those of its surface are channels 4 and up."""
    chain: Sequence[NDArray[np.uint8]] = [cards.atlas.image] if cards.chain is None else cards.chain
    if cards.atlas.surface is not None:
        surfaces = [cards.atlas.surface] if cards.surface_chain is None else cards.surface_chain
        chain = [np.concatenate(level, -1) for level in zip(chain, surfaces, strict=True)]
    return joined(chain, (*cards.atlas.image.shape[:2], chain[0].shape[-1] if chain else 4))


def sheets_of(cards: Cards) -> Sheets:
    """The textured planes of cards, in the order of their first cards; cards without an area are left out."""
    planes: list[tuple[list[Card], NDArray[np.float64]]] = []
    known, of_piece, pieces = dict[tuple[int, bool], list[int]](), list[int](), list[Card]()
    for card in cards.cards:
        if area(card.uvs) == 0:
            continue
        numbers = known.setdefault((card.rectangle, card.culled), [])
        number = next((number for number in numbers if _lies_in(card, *planes[number])), len(planes))
        if number == len(planes):
            middle, center = card.uvs.mean(0), card.corners.mean(0)
            slopes = (np.linalg.pinv(card.uvs - middle) @ (card.corners - center)).T
            planes.append(([], np.concatenate([np.column_stack([slopes, center - slopes @ middle]), [[0.0, 0.0, 1.0]]])))
            numbers.append(number)
        planes[number][0].append(card)
        of_piece.append(number)
        pieces.append(card)
    order = np.argsort(of_piece, kind="stable").tolist()
    of_piece, pieces = [of_piece[number] for number in order], [pieces[number] for number in order]
    starts, ones = np.concatenate([[0], cards.atlas.sizes.prod(-1).cumsum()]), [own[0] for own, _ in planes]
    return Sheets(
        torch.from_numpy(np.array([to_world for _, to_world in planes], np.float64).reshape(-1, 4, 3)),
        _rows([one.normal for one in ones], 3),
        _rows([np.concatenate([card.corners for card in own]).mean(0) for own, _ in planes], 3),
        torch.from_numpy(np.array([texture_axes(one) for one in ones], np.float64).reshape(-1, 3, 3)),
        torch.tensor([one.culled for one in ones], dtype=torch.bool),
        torch.tensor([int(starts[one.rectangle]) for one in ones], dtype=torch.int64),
        torch.tensor(of_piece, dtype=torch.int64),
        _padded([_homogeneous(card.corners) for card in pieces], 4),
        _padded([np.column_stack(sides(card.uvs)) for card in pieces], 3),
    )


def _lies_in(card: Card, own: list[Card], to_world: NDArray[np.float64]) -> bool:
    """Whether a card lies in the plane of other cards of its texture, and shows its part of the texture."""
    off = _homogeneous(card.uvs) @ to_world[:3].T - card.corners
    return bool(own[0].normal @ card.normal > 0 and abs(off).max() <= _SAME * abs(card.corners).max())


def _rows(vectors: list[NDArray[np.float64]], width: int) -> Tensor:
    return torch.from_numpy(np.array(vectors, np.float64).reshape(-1, width))


def _padded(arrays: list[NDArray[np.float64]], width: int) -> Tensor:
    """Arrays [k, width] with their last rows repeated, [Q, K, width]."""
    counts = np.array([len(array) for array in arrays], np.int64)[:, None]
    rows = counts.cumsum()[:, None] - counts + np.minimum(np.arange(counts.max(initial=1)), counts - 1)
    return torch.from_numpy(np.concatenate([*arrays, np.empty((0, width))])[rows])


def seen_axes(sheets: Sheets, camera: Camera) -> Tensor:
    """The axes of the normals of each plane as V cameras see them, [V, S, 3, 3]: from behind, those of both sides turn."""
    behind = (_distances(sheets, camera.batch().to("cpu").to(torch.float64))[0] < 0) & ~sheets.culled
    return torch.where(behind[..., None, None], -sheets.axes, sheets.axes)


def _distances(sheets: Sheets, camera: Camera) -> tuple[Tensor, Tensor]:
    """How far V cameras are in front of each plane (negative: behind it), and how far from its center, [V, S] each."""
    towards = -camera.forward[:, None].expand(-1, len(sheets), 3) if camera.orthographic else camera.position[:, None] - sheets.centers
    return (towards * sheets.normals).sum(-1), towards.norm(dim=-1)


def _boxes(sheets: Sheets, camera: Camera, shown: Tensor) -> tuple[Tensor, Tensor]:
    """The first pixel of the box around each piece, and that after the last, x and y, int64 [V, Q, 2] each.

    They are empty for sheets that are not ``shown``, bool [V, S].
    """
    corners = sheets.corners @ camera.world_to_pixel[:, None].mT
    bounded = (corners[..., 2] > 1e-9).all(-1, keepdim=True)  # otherwise a part is behind the camera, and the corners bound nothing
    at, size = corners[..., :2] / corners[..., 2:], torch.tensor([camera.width, camera.height], dtype=torch.float64)
    low, high = (torch.minimum(edge.clamp_min(0), size) for edge in (at.amin(-2).floor(), at.amax(-2).floor() + 2))
    low, high = torch.where(bounded, low, 0).long(), torch.where(bounded, high, size).long()
    return low, torch.where(shown[:, sheets.of_piece, None], torch.maximum(low, high), low)


def _homogeneous(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([points, np.ones(len(points))])
