"""Shape-adaptive wavelets of integer pictures: a lossless transform of the pixels inside a mask of any shape, into as many coefficients.

After Li and Li 2000, "Shape-Adaptive Discrete Wavelet Transforms for Arbitrarily Shaped Visual Object Coding": each run of pixels in a row,
and then in a column, is filtered for itself, with its ends mirrored, and positions keep their parity. The filter is the reversible 5/3
lifting of Calderbank et al. 1998, "Wavelet Transforms That Map Integers to Integers" (also in JPEG 2000).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int32]
Mask = NDArray[np.bool_]


def transformed(picture: Integers, mask: Mask, levels: int) -> Integers:
    """Wavelet coefficients in the places of the pixels, [H, W]: level l leaves its low band where both indices are multiples of 2 ** l.

    Pixels outside the mask [H, W] are ignored, and zero in the result.
    """
    result = np.where(mask, picture, 0).astype(np.int32)
    for level in range(levels):
        values, inside = result[:: 1 << level, :: 1 << level], mask[:: 1 << level, :: 1 << level]
        for array, within in ((values, inside), (values.T, inside.T)):
            _predict(array, within, -1)
            _update(array, within, 1)
    return result


def restored(coefficients: Integers, mask: Mask, levels: int) -> Integers:
    """The picture of coefficients, [H, W]: exactly what :func:`transformed` was given inside the mask, and zero outside."""
    result = np.where(mask, coefficients, 0).astype(np.int32)
    for level in reversed(range(levels)):
        values, inside = result[:: 1 << level, :: 1 << level], mask[:: 1 << level, :: 1 << level]
        for array, within in ((values.T, inside.T), (values, inside)):
            _update(array, within, -1)
            _predict(array, within, 1)
    return result


def band_of(rows: int, columns: int, levels: int) -> NDArray[np.int8]:
    """How often each coefficient was in a low band, [rows, columns] in 0 to ``levels``."""
    low = [np.minimum(_halvings(count, levels), levels) for count in (rows, columns)]
    return np.minimum(low[0][:, None], low[1][None, :]).astype(np.int8)


def _halvings(count: int, levels: int) -> NDArray[np.int64]:
    index = np.arange(count)
    return np.sum([index % (1 << level) == 0 for level in range(1, levels + 1)], axis=0, dtype=np.int64)


def _predict(values: Integers, mask: Mask, sign: int) -> None:
    """Add to the odd columns, in place, what their neighbors predict, times ``sign``."""
    odd = values[:, 1::2]
    near, _ = _neighbors(values[:, 0::2], mask[:, 0::2], slice(0, odd.shape[1]), slice(1, odd.shape[1] + 1))
    odd += np.where(mask[:, 1::2], sign * (near >> 1), 0)


def _update(values: Integers, mask: Mask, sign: int) -> None:
    """Add to the even columns, in place, a share of their neighbors' details, times ``sign``."""
    even = values[:, 0::2]
    near, any_near = _neighbors(values[:, 1::2], mask[:, 1::2], slice(-1, even.shape[1] - 1), slice(0, even.shape[1]))
    even += np.where(mask[:, 0::2] & any_near, sign * ((near + 2) >> 2), 0)


def _neighbors(values: Integers, mask: Mask, left: slice, right: slice) -> tuple[Integers, Mask]:
    """The sum of the neighbors to the left and right, and whether there is any. The other replaces one outside the mask, and 0 both."""
    padded, inside = np.pad(np.where(mask, values, 0), ((0, 0), (1, 1))), np.pad(mask, ((0, 0), (1, 1)))
    (low, low_in), (high, high_in) = (
        (padded[:, each.start + 1 : each.stop + 1], inside[:, each.start + 1 : each.stop + 1]) for each in (left, right)
    )
    return np.where(low_in, low, high) + np.where(high_in, high, low), low_in | high_in
