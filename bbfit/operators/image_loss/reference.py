"""Losses of a render against a view, in torch."""

from __future__ import annotations

from torch import Tensor

from bbfit.operators.config import Loss
from bbfit.operators.sharpness.reference import sharpness_reference
from bbfit.operators.ssim.reference import ssim_reference


def image_loss_reference(render: Tensor, target: Tensor, kind: Loss, ssim_weight: float, sharpness_weight: float = 0.0) -> Tensor:
    """Loss of a render, a scalar that is differentiable in both pictures.

    Parameters
    ----------
    render, target
        Premultiplied RGBA in [0, 1], [V, H, W, 4].
    kind
        Loss of a pixel (:func:`pixel_loss_reference`), whose mean is taken.
    ssim_weight, sharpness_weight
        Factors of 1 - SSIM (:func:`~bbfit.operators.ssim.reference.ssim_reference`) and of
        :func:`~bbfit.operators.sharpness.reference.sharpness_reference`, which are added.
    """
    return pixel_loss_reference(render, target, kind).mean() + structure_loss_reference(render, target, ssim_weight, sharpness_weight)


def structure_loss_reference(render: Tensor, target: Tensor, ssim_weight: float, sharpness_weight: float) -> Tensor:
    """The terms of :func:`image_loss_reference` for structure and sharpness, a scalar; arguments as there."""
    loss = render.new_zeros(())
    if ssim_weight:
        loss = loss + ssim_weight * (1 - ssim_reference(render, target))
    if sharpness_weight:
        loss = loss + sharpness_weight * sharpness_reference(render, target)
    return loss


def pixel_loss_reference(render: Tensor, target: Tensor, kind: Loss) -> Tensor:
    """Loss of every pixel, [V, H, W], of premultiplied RGBA in [0, 1], [V, H, W, 4]; differentiable in both pictures.

    ``l1`` and ``l2`` are absolute and squared differences, summed over the four channels (thesis, section 4.4).

    ``backgrounds`` is the expected squared difference of colors over an opaque background whose channels b are independent and uniform in
    [0, 1]. With the differences c of premultiplied color and a of alpha, E[b] = 1/2 and E[b^2] = 1/3 give

        sum over channels of E[(c - a b)^2] = sum of (c^2 - a c) + a^2,

    which is ``l2`` minus one term: where alpha is missing too, missing color costs less, because the background shows instead.
    """
    difference = render - target
    loss = (difference.abs() if kind == "l1" else difference.square()).sum(-1)
    if kind == "backgrounds":
        loss = loss - difference[..., 3] * difference[..., :3].sum(-1)
    return loss


def color_loss_reference(colors: list[Tensor], weights: list[Tensor], target: Tensor) -> Tensor:
    """Loss of the colors of N layers against the views' own, a scalar that is differentiable in the colors alone.

    It is the mean over pixels of the sum over layers of w A |c - C|^2, less a term that does not depend on c. A is the view's alpha and C
    its straight color. Where a view is half transparent, the best color is therefore the view's color, not a mixture with the background
    (as it is for the loss ``backgrounds``, if the layer is opaque there).

    Parameters
    ----------
    colors
        Straight colors of the layers, N of [V, 3, H, W].
    weights
        Weights w of the layers in the picture, N of [V, 1, H, W]. They are held constant.
    target
        Premultiplied RGBA, [V, H, W, 4].
    """
    premultiplied, alpha = target.permute(0, 3, 1, 2).split((3, 1), 1)
    losses = [(w.detach() * (alpha * c.square() - 2 * premultiplied * c)).sum(1) for c, w in zip(colors, weights, strict=True)]
    return sum(losses[1:], losses[0]).mean()
