"""Drawing of cards by a Warp kernel on the CPU."""

from __future__ import annotations

import ctypes
import math
from typing import Any

import torch
import warp as wp
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.light import Light
from bbfit.operators.cards.kernels import Fragment, draw_rows
from bbfit.operators.cards.sheets import PreparedCards, SeenSheets, seen_axes, seen_sheets
from bbfit.operators.drawing.fused import encoded_alpha
from bbfit.operators.launching import LEAST_PIXELS, in_parallel, pieces_of, repeated, struct_array, warp_array, worker_count


def draw_cards_fused(prepared: PreparedCards, camera: Camera, light: Light | None = None) -> Tensor:
    """:func:`~bbfit.operators.cards.reference.draw_cards_reference`, but for rounding. Equal inputs give equal bytes."""
    return _drawn(prepared, camera, light, multisampled=prepared.multisampled)[0]


def count_fragments_fused(prepared: PreparedCards, camera: Camera) -> int:
    """The number of :func:`~bbfit.operators.cards.reference.hits` with one sample a pixel, in V cameras."""
    return int(_drawn(prepared, camera, multisampled=False)[1].sum())


def _drawn(prepared: PreparedCards, camera: Camera, light: Light | None = None, *, multisampled: bool) -> tuple[Tensor, Tensor]:
    """The pictures, float32 [V, H, W, 4], and the numbers of fragments in their rows, int32 [V, H]."""
    sheets, levels, views, height, width = prepared.sheets, prepared.levels, len(camera), camera.height, camera.width
    image, counts = torch.zeros(views, height, width, 4), torch.zeros(views, height, dtype=torch.int32)
    if not len(sheets) or not views:
        return image, counts
    seen = seen_sheets(sheets, camera)
    tensors = [
        (torch.cat([seen.low, seen.high], -1).int(), wp.vec4i),
        (sheets.of_piece.int(), wp.int32),
        (sheets.sides, wp.vec3d),
        (seen.to_uv, wp.mat33d),
        (seen.to_depth, wp.vec3d),
        (sheets.first.int(), wp.int32),
        (torch.stack([levels.starts, levels.widths, levels.heights], -1).int(), wp.vec3i),
        *((part, wp.vec4ub) for part in prepared.channels),
        *_lights(prepared, camera, light),
    ]
    inputs = [
        height,
        width,
        encoded_alpha(prepared.cards.alpha),
        int(multisampled),
        int(prepared.cards.traced),
        *(warp_array(tensor.contiguous(), kind) for tensor, kind in tensors),
    ]
    on, outputs, threads = wp.device_from_torch(image.device), [warp_array(image, wp.vec4), warp_array(counts, wp.int32)], worker_count()
    most = min(_most_fragments(seen, height), len(sheets) * width)  # a pixel sees a sheet once
    heads = warp_array(torch.empty(threads, 2, width, dtype=torch.int32), wp.int32)
    numbers = ctypes.sizeof(Fragment.ctype) // 4  # type: ignore[attr-defined]
    fragments = struct_array(torch.empty(threads, most, numbers, dtype=torch.int32), Fragment)
    again = repeated(draw_rows, lambda thread: [thread, heads, fragments, *inputs], outputs, on)

    def launch(begin: int, end: int) -> None:
        again((end - begin, 1), begin)

    in_parallel(launch, pieces_of(views * height, -(-LEAST_PIXELS // width)))
    return image, counts


def _lights(prepared: PreparedCards, camera: Camera, light: Light | None) -> list[tuple[Tensor, Any]]:
    """The direction towards the sun in the axes of each sheet, and the sun's color with the strength of the sky; or neither."""
    if light is None:
        return [(torch.empty(0, 0, 3), wp.vec3), (torch.empty(0, 4), wp.vec4)]
    light = light[[0] * len(camera)] if len(light) == 1 else light
    towards = (seen_axes(prepared.sheets, camera) @ light.sun_directions[:, None, :, None])[..., 0]
    suns = light.sun_colors * light.sun_strengths[:, None] / math.pi
    return [(towards.float(), wp.vec3), (torch.cat([suns, light.ambients[:, None]], -1).float(), wp.vec4)]


def _most_fragments(seen: SeenSheets, height: int) -> int:
    """The most pixels in boxes of pieces in any row of any view."""
    widths = (seen.high - seen.low)[..., 0]
    steps = torch.zeros(len(widths), height + 1, dtype=torch.int64)
    steps.scatter_add_(1, seen.low[..., 1], widths).scatter_add_(1, seen.high[..., 1], -widths)
    return max(1, int(steps.cumsum(1).max()))
