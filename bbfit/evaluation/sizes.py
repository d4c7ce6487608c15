"""Scoring whatever draws a tree when it is seen from afar: in pictures of a half, a quarter and so on of the views' size."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.checks import check_count, check_shape, fail
from bbfit.evaluation import metrics
from bbfit.evaluation.report import SizeScore
from bbfit.geometry.camera import Camera
from bbfit.images import over_color
from bbfit.views import ViewSet

HALVINGS = 4
"""How many times an evaluation halves the views' size."""


def score_sizes(
    draw: Callable[[Camera], Tensor], views: ViewSet, halvings: int = HALVINGS, *, on_size: Callable[[int, int], None] | None = None
) -> tuple[SizeScore, ...]:
    """Compare what is drawn at the views' size, at a half of it and so on with the views averaged to that size.

    A smaller camera covers the same field of view with fewer pixels, as if the tree were farther away. A target's pixel is the mean of
    what it covers of the view, by area, also where sides are odd: of the premultiplied display-referred values as they stand, as in all
    of bbfit's scores, so without conversion to linear light. Coverage is then the same at all sizes. Draws are clamped to [0, 1].

    Drawn with one sample a pixel, a small picture of a tree covers some per cent more or less by chance; where pixels are halved, the
    coverage of draws is the mean of several, 4 at half of the size and 16 below, whose pixels are moved by fractions of their width.

    Parameters
    ----------
    draw : premultiplied RGBA over nothing, [B, H, W, 4], as a batch of cameras sees it: a renderer of clouds, or of what was exported.
    views : V held-out views.
    halvings : how often to halve; sizes of which a side is below 11 pixels (:data:`bbfit.evaluation.metrics.SSIM_WINDOW`) are left out.
    on_size : called after each size with the number of sizes done and of all.

    Returns
    -------
    At most ``halvings + 1`` scores, the largest size first.

    Raises
    ------
    InputError
        if there are no views, they are too small, ``halvings`` is negative, or what is drawn has another shape or is not finite.
    """
    check_count("halvings", halvings, 0)
    if len(views) == 0:
        fail("views", "there is no held-out view to measure on", "give views with a test split")
    metrics.check_size(views.cameras.width, views.cameras.height)
    scores = []
    for halving in range(halvings + 1):
        width, height = views.cameras.width >> halving, views.cameras.height >> halving
        if min(width, height) >= metrics.SSIM_WINDOW:
            scores.append(_score(draw, views, halving, width, height))
        if on_size is not None:
            on_size(halving + 1, halvings + 1)
    return tuple(scores)


def shrunk(picture: Tensor, width: int, height: int) -> Tensor:
    """A picture at another size of no more pixels a side, every pixel the mean of what it covers, by area: [H, W, C] -> [h, w, C].

    Raises
    ------
    InputError
        if the new size is larger, or not at least 1 x 1.
    """
    for name, side, old in (("width", width, picture.shape[1]), ("height", height, picture.shape[0])):
        check_count(name, side)
        if side > old:
            fail(name, f"expected at most the picture's {old}, got {side}")
    if tuple(picture.shape[:2]) == (height, width):
        return picture
    return _means(_means(picture.double(), height).transpose(0, 1), width).transpose(0, 1).to(picture)


def _means(values: Tensor, count: int) -> Tensor:
    """Means of ``count`` equal parts of the first axis, by differences of the running sum, which is linear within a value."""
    edges = torch.arange(count + 1, dtype=values.dtype) * (len(values) / count)
    whole = edges.long().clamp(max=len(values) - 1)
    before = torch.cat([torch.zeros_like(values[:1]), values.cumsum(0)[:-1]])
    sums = before[whole] + (edges - whole).view(-1, *[1] * (values.ndim - 1)) * values[whole]
    return sums.diff(dim=0) * (count / len(values))


def _score(draw: Callable[[Camera], Tensor], views: ViewSet, halving: int, width: int, height: int) -> SizeScore:
    cameras = views.cameras.resized(width, height)
    psnrs, squares, drawn, wanted = [], [], 0.0, 0.0
    for index, name in enumerate(views.names):
        target = shrunk(views.targets([index], torch.float64)[0], width, height)
        batch = _shifted(cameras[index], min(halving, 2))
        with torch.no_grad():
            images = draw(batch).detach().cpu().double()
        check_shape(f"what is drawn of view {name}", tuple(images.shape), (len(batch), height, width, 4))
        if not images.isfinite().all():
            fail("draw", f"gives numbers that are not finite for view {name} at {width} x {height} pixels", "check the model")
        seen, *shifted = images.clamp(0, 1)
        psnrs.append(metrics.psnr(over_color(target).numpy(), over_color(seen).numpy()))
        squares.append(metrics.mean_squared_error(target[..., 3].numpy(), seen[..., 3].numpy()))
        covers = [float(image[..., 3].sum()) for image in shifted or [seen]]
        drawn += sum(covers) / len(covers)
        wanted += float(target[..., 3].sum())
    mean_square = sum(squares) / len(views)
    return SizeScore(width, height, sum(psnrs) / len(views), drawn / wanted if wanted else None, mean_square**0.5)


def _shifted(camera: Camera, halvings: int) -> Camera:
    """The camera, and if there are halvings itself with its pixels' centers moved to those of their 4^halvings parts."""
    parts = 2**halvings
    steps = [(part + 0.5) / parts - 0.5 for part in range(parts)]
    moves = [(0.0, 0.0), *(itertools.product(steps, steps) if halvings else ())]
    shift = torch.tensor([[[0, 0, right], [0, 0, down], [0, 0, 0]] for right, down in moves]).to(camera.intrinsics)
    return replace(camera, world_to_camera=camera.world_to_camera.expand(len(moves), 4, 4), intrinsics=camera.intrinsics + shift)
