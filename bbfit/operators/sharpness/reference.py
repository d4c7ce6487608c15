"""Difference in sharpness in torch."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

BLOCK = 8
"""Width and height in pixels of the blocks over which contrast is averaged."""


def sharpness_reference(render: Tensor, target: Tensor) -> Tensor:
    """Mean squared difference of local contrast between two pictures over white, a scalar that is differentiable in both.

    The contrast of a block of 8 x 8 pixels is the mean absolute difference between neighboring pixels, taken along rows and along columns.
    The squared difference of the two pictures' contrasts is averaged over blocks, channels and views, and summed over both directions. It
    is 0 if both pictures are equally sharp, wherever in a block the detail lies.

    A squared difference of colors alone is least for a blurred picture wherever no detail is correct in every view.

    Parameters
    ----------
    render, target
        Premultiplied RGBA in [0, 1], [V, H, W, 4].
    """
    total = render.new_zeros(())
    white = [(image[..., :3] + 1 - image[..., 3:]).permute(0, 3, 1, 2) for image in (render, target)]
    for axis, margin in ((3, (0, 1)), (2, (0, 0, 0, 1))):
        across = [pad(image.diff(dim=axis).abs(), margin) for image in white]
        height, width = across[0].shape[2:]
        spare = (0, -width % BLOCK, 0, -height % BLOCK)
        first, second = (avg_pool2d(pad(image, spare), BLOCK) for image in across)
        total = total + (first - second).square().mean()
    return total
