"""Drawing of cards by a Warp kernel on the CPU."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.operators.cards.kernels import Fragment, draw_rows
from bbfit.operators.cards.sheets import PreparedCards, SeenSheets, seen_sheets
from bbfit.operators.drawing.fused import encoded_alpha
from bbfit.operators.launching import LEAST_PIXELS, in_parallel, pieces_of, repeated, struct_array, warp_array, worker_count

# Numbers of 32 bits in a fragment.
_FRAGMENT = 10


def draw_cards_fused(prepared: PreparedCards, camera: Camera) -> Tensor:
    """:func:`~bbfit.operators.cards.reference.draw_cards_reference`, but for rounding. Equal inputs give equal bytes."""
    return _drawn(prepared, camera)[0]


def count_fragments_fused(prepared: PreparedCards, camera: Camera) -> int:
    """The number of :func:`~bbfit.operators.cards.reference.hits`, of cards without maps in V cameras."""
    return int(_drawn(prepared, camera)[1].sum())


def _drawn(prepared: PreparedCards, camera: Camera) -> tuple[Tensor, Tensor]:
    """The pictures, float32 [V, H, W, 4], and the numbers of fragments in their rows, int32 [V, H]."""
    sheets, levels, views, height, width = prepared.sheets, prepared.levels, len(camera), camera.height, camera.width
    image, counts = torch.zeros(views, height, width, 4), torch.zeros(views, height, dtype=torch.int32)
    if not len(sheets) or not views:
        return image, counts
    seen = seen_sheets(sheets, camera)
    by_sheet = sheets.of_piece.sort(stable=True).indices
    boxes = torch.cat([seen.low, seen.high], -1)[:, by_sheet].int()
    tensors = [
        (boxes, wp.vec4i),
        (sheets.of_piece[by_sheet].int(), wp.int32),
        (sheets.sides[by_sheet], wp.vec3d),
        (seen.to_uv, wp.mat33d),
        (seen.to_depth, wp.vec3d),
        (sheets.first.int(), wp.int32),
        (torch.stack([levels.starts, levels.widths, levels.heights], -1).int(), wp.vec3i),
        (levels.texels, wp.vec4ub),
    ]
    inputs = [height, width, encoded_alpha(prepared.cards.alpha), *(warp_array(tensor.contiguous(), kind) for tensor, kind in tensors)]
    on, outputs, threads = wp.device_from_torch(image.device), [warp_array(image, wp.vec4), warp_array(counts, wp.int32)], worker_count()
    heads = warp_array(torch.empty(threads, 2, width, dtype=torch.int32), wp.int32)
    fragments = struct_array(torch.empty(threads, _most_fragments(seen, height), _FRAGMENT, dtype=torch.int32), Fragment)
    again = repeated(draw_rows, lambda thread: [thread, heads, fragments, *inputs], outputs, on)

    def launch(begin: int, end: int) -> None:
        again((end - begin, 1), begin)

    in_parallel(launch, pieces_of(views * height, -(-LEAST_PIXELS // width)))
    return image, counts


def _most_fragments(seen: SeenSheets, height: int) -> int:
    """The most pixels in boxes of pieces in any row of any view."""
    widths = (seen.high - seen.low)[..., 0]
    steps = torch.zeros(len(widths), height + 1, dtype=torch.int64)
    steps.scatter_add_(1, seen.low[..., 1], widths).scatter_add_(1, seen.high[..., 1], -widths)
    return max(1, int(steps.cumsum(1).max()))
