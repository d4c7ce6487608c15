"""Fused values and gradients as differentiable functions."""

from __future__ import annotations

from torch import Tensor


def differentiable(value: Tensor, picture: Tensor, gradient: Tensor) -> Tensor:
    """A scalar that is equal to ``value`` and whose gradient in ``picture`` is ``gradient``.

    Parameters
    ----------
    value : Tensor
        A scalar without a graph.
    picture, gradient : Tensor
        Tensors of one shape; the picture's values are finite.
    """
    return value + (gradient * (picture - picture.detach())).sum()
