"""Matching of coverage: a cloud covers as much of the pictures as the tree does; a mask from every side, as far as possible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.config import Backend
from bbfit.rendering.dispatch import render
from bbfit.views.view_set import ViewSet, evenly

# Largest shift of alpha, iterations of the bisection, and Gauss-Newton steps.
_MAX_SHIFT, _BISECTIONS, _GAUSS_NEWTON_STEPS = 0.3, 8, 2
# Exponent that spreads alpha. It applies to the distance from the cutoff as a fraction of the largest possible distance.
_SPREAD = 0.4
# Largest side of the pictures in which the derivatives of coverage are measured, in pixels, and the slope of the ramp that replaces the
# cutoff for them: texels within 0.05 of the cutoff count.
_SIDE, _HARDNESS = 256, 10.0
# Most pixels that are drawn at once.
_PIXELS = 1 << 22


def matched_coverage(cloud: BillboardCloud, views: ViewSet, backend: Backend = "auto") -> BillboardCloud:
    """Adjust the alpha of a masked cloud so that it covers as much of the views as the tree does, and round its texels to 8 bits.

    After a fit for hard edges, the alpha of texels that are in some views and not in others lies within a thousandth of the cutoff.
    Rounding to 8 bits would move all of them to the same side of the cutoff. This function therefore spreads the distances from the cutoff
    and keeps the order of texels. For an antialiased mask it does not, because there alpha's slope is the width of an edge. It then shifts
    alpha by one number per billboard, except where alpha is 0.

    Before the shifts, a cloud may cover a fifth less than the tree from sides that few of its billboards face, and a tenth more from
    others. The shifts are a ridge regression of the relative errors of coverage in single views, of which at most 24, evenly spaced, are
    compared. A ramp instead of the cutoff linearizes the coverage, and Gauss-Newton steps repeat the solution. Last, bisection finds a
    number to add to all shifts that makes the coverage of all views together right. Larger shifts would improve single views, but cost
    more quality than they gain: for an acer the standard deviation of the coverage error over views is 8.8 % without shifts and 6.8 %
    with them, for 0.08 dB; a willow gains 0.04 dB.
    """
    indices = _compared(views)
    if len(cloud) == 0 or not indices:
        return cloud
    count, cameras = len(indices), views.cameras[indices].to(cloud.texels.device)
    target = torch.stack([views.image(index)[..., 3].double().mean() / 255 for index in indices])
    rounded = (cloud.texels * 255).round() / 255
    alpha, cutoff = cloud.texels[:, 3], cloud.alpha.cutoff
    room = torch.where(alpha >= cutoff, 1 - cutoff, cutoff)
    spread = alpha
    if not cloud.alpha.antialiased:
        spread = cutoff + (alpha - cutoff).sign() * room * ((alpha - cutoff).abs() / room) ** _SPREAD
    billboard = torch.repeat_interleave((cloud.texture_sizes.prod(-1) * (1 + cloud.two_sided.long())).to(alpha.device))
    hardness = max(_HARDNESS, 0.5 / min(cutoff, 1 - cutoff))
    soft = replace(cloud, alpha=replace(cloud.alpha, hardness=hardness))

    def shifted_alpha(shifts: Tensor) -> Tensor:
        return torch.where(alpha > 0, spread + shifts.to(alpha)[billboard], 0).clamp(0, 1)

    def shifted(shifts: Tensor) -> BillboardCloud:
        return cloud.with_texels(torch.cat([rounded[:, :3], (shifted_alpha(shifts) * 255).round()[:, None] / 255], 1))

    def coverage(shifts: Tensor, cameras: Camera) -> Tensor:
        result, at_once = shifted(shifts), max(1, _PIXELS // (cameras.width * cameras.height))
        images = (image for some in torch.arange(count).split(at_once) for image in render(result, cameras[some], backend=backend))
        return torch.stack([image[..., 3].double().mean().cpu() for image in images])

    def slopes(shifts: Tensor, camera: Camera) -> Tensor:
        """Derivatives of a view's coverage in the shifts, [N]."""
        with torch.enable_grad():
            shifts = shifts.clone().requires_grad_()
            texels = torch.cat([rounded[:, :3], shifted_alpha(shifts)[:, None]], 1)
            covered = render(soft.with_texels(texels), camera, backend=backend)[..., 3].mean()
            return torch.autograd.grad(covered, shifts)[0]

    def balanced(shifts: Tensor, cameras: Camera) -> Tensor:
        return shifts + _root(lambda offset: float((coverage(shifts + offset, cameras) - target).mean()))

    reduction = max(1.0, max(cameras.width, cameras.height) / _SIDE)
    small = cameras.resized(*(max(1, round(side / reduction)) for side in (cameras.width, cameras.height)))
    with torch.no_grad():
        shifts = initial = balanced(torch.zeros(len(cloud), dtype=torch.float64), small)
        jacobian = torch.stack([slopes(shifts, small[index]) for index in range(count)]) / target[:, None]
        normal = jacobian.mT @ jacobian
        ridge = normal.diagonal().mean() * torch.eye(len(cloud), dtype=torch.float64)
        for _ in range(_GAUSS_NEWTON_STEPS if float(ridge.max()) > 0 else 0):
            errors = 1 - coverage(shifts, small) / target
            shifts = shifts + torch.linalg.solve(normal + ridge, jacobian.mT @ errors - ridge @ (shifts - initial))
            shifts = shifts.clamp(-_MAX_SHIFT, _MAX_SHIFT)
        return shifted(balanced(shifts, cameras))


def scaled_coverage(cloud: BillboardCloud, views: ViewSet, backend: Backend = "auto") -> BillboardCloud:
    """Multiply the alpha of a cloud with the mode ``coverage`` by one number so that it covers as much of the views as the tree does.

    Rounding to a few samples takes more from faint texels than it gives, and the fit knows nothing of it: without this, a cherry covers
    0.9 of what it should with four samples. At most 24 views, evenly spaced, are compared.
    """
    indices, cameras = _compared(views), views.cameras.to(cloud.texels.device)
    if len(cloud) == 0 or not indices:
        return cloud
    target = sum(float(views.image(index)[..., 3].double().mean()) / 255 for index in indices)

    def scaled(excess: float) -> BillboardCloud:
        alpha = ((cloud.texels[:, 3:] * (1 + excess)).clamp(0, 1) * 255).round() / 255
        return cloud.with_texels(torch.cat([cloud.texels[:, :3], alpha], 1))

    def missed(excess: float) -> float:
        pictures = (render(scaled(excess), cameras[[index]], backend=backend) for index in indices)
        return sum(float(picture[..., 3].double().mean()) for picture in pictures) - target

    with torch.no_grad():
        return scaled(_root(missed))


def _compared(views: ViewSet) -> list[int]:
    """Indices of views, evenly spaced among those that show something: an empty one has no relative error."""
    return evenly(list(filter(views.shows, range(len(views)))))


def _root(excess: Callable[[float], float]) -> float:
    """Find the root of an increasing function in [-``_MAX_SHIFT``, ``_MAX_SHIFT``] by bisection, or the end that is closest to one."""
    low, high = -_MAX_SHIFT, _MAX_SHIFT
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return 0.5 * (low + high)
