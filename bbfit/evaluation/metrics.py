"""Differences between the render and the target of one view, with a data range of 1.

All functions take the target first and return a ``float`` that is summed in float64. Pictures are RGB [H, W, 3], composited over an opaque
background (:func:`bbfit.images.over_color`), or premultiplied RGBA [H, W, 4]; both hold display-referred values in [0, 1].

All results are finite, so JSON can hold them. A mean squared error counts as at least :data:`MSE_FLOOR`, so identical pictures have a PSNR
of 120 dB. A ratio is ``None`` and left out of averages if the target has none of the quantity: the sharpness of a flat picture, the
brightness of an empty or black silhouette.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_shape, fail

Image = NDArray[np.floating[Any]]
ColorSum = tuple[float, float, float, float]
"""Sums of premultiplied red, green, blue and of alpha over pixels (:func:`color_sum`)."""

MSE_FLOOR = 1e-12
"""Smallest mean squared error in a logarithm: a root mean square of one millionth of the data range."""
SSIM_WINDOW = 11
"""Side of the SSIM window in pixels, which is the side of the smallest picture that can be measured."""
ALPHA_THRESHOLD = 0.5
"""Smallest alpha of a pixel of the silhouette."""
_HAUSDORFF_SHARE = 0.95
# How far in pixels the difference of a pixel reaches in a FLIP map, whose filters are for 67 pixels a degree.
_FLIP_REACH = 10
# Largest CIELAB chroma of a gray; rounding gives gray pixels one of 0.01 or less.
_GRAY_CHROMA = 0.1
# Largest sum of red, green and blue of a black, far below a step of 8 bits.
_BLACK = 1e-6


def mean_squared_error(target: Image, render: Image) -> float:
    """Mean of the squared differences over all pixels and channels; pictures of any equal shape."""
    check_shape("render", render.shape, target.shape)
    return float(np.square(np.subtract(target, render, dtype=np.float64)).mean())


def root_mean_squared_error(target: Image, render: Image) -> float:
    """Square root of :func:`mean_squared_error`, in [0, 1]; lower is better."""
    return float(np.sqrt(mean_squared_error(target, render)))


def psnr(target: Image, render: Image) -> float:
    """Peak signal-to-noise ratio in dB, at most 120; higher is better: ``-10 log10(mse)`` with one error over all pixels and channels."""
    return decibels(mean_squared_error(target, render))


def decibels(mse: float) -> float:
    """A mean squared error of values in [0, 1] as a peak signal-to-noise ratio in dB, at most 120."""
    return float(-10 * np.log10(max(mse, MSE_FLOOR)))


def ssim(target: Image, render: Image) -> float:
    """Structural similarity of two RGB pictures, in [-1, 1]; higher is better (Wang et al. 2004).

    Gaussian window of 11 x 11 pixels with a standard deviation of 1.5, as in the paper's section III-C; the mean over channels and over the
    pixels whose window lies inside the picture. Raises InputError if a side of the picture is shorter than the window.
    """
    return mean_similarity(
        target,
        render,
        SSIM_WINDOW,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        truncate=3.5,  # 3.5 standard deviations reach five pixels to each side: 11 taps
        use_sample_covariance=False,
    )


def mean_similarity(target: Image, render: Image, window: int, **options: Any) -> float:
    """The mean of scikit-image's ``structural_similarity`` with some options over the channels of two pictures of any number of them.

    It is the mean over pixels whose window of side ``window`` lies inside the picture. Equal windows have a similarity of 1, so only the
    part around the pixels that differ is computed. Raises InputError if the pictures are too small (:func:`check_size`).
    """
    from skimage.metrics import structural_similarity

    check_shape("render", render.shape, target.shape)
    check_size(target.shape[1], target.shape[0])
    reach = window // 2
    part = _around_differences(target, render, 2 * reach)
    if part is None:
        return 1.0
    pair = (picture[part].astype(np.float64) for picture in (target, render))
    _, similarity = structural_similarity(*pair, channel_axis=2, full=True, **options)
    inside = similarity[reach:-reach, reach:-reach]
    values = (target.shape[0] - 2 * reach) * (target.shape[1] - 2 * reach) * target.shape[2]
    return float(1 - (1 - inside).sum(dtype=np.float64) / values)


def check_size(width: int, height: int) -> None:
    """Raise InputError for pictures with a side shorter than the SSIM window."""
    if min(width, height) < SSIM_WINDOW:
        fail(
            "views",
            f"pictures of {width} x {height} pixels are too small to measure",
            f"SSIM needs at least {SSIM_WINDOW} x {SSIM_WINDOW}; render larger views",
        )


def flip_map(target: Image, render: Image) -> NDArray[np.float64]:
    """Perceived difference of each pixel of two RGB pictures, [H, W] in [0, 1] (Andersson et al. 2020, "FLIP").

    For a viewer at 67 pixels a degree (0.7 m from a screen of 3840 pixels on 0.7 m), the default of the authors' implementation.

    Equal neighborhoods have no difference, so only the part around the pixels that differ is computed.
    """
    import flip_evaluator

    check_shape("target", target.shape, (None, None, 3))
    check_shape("render", render.shape, target.shape)
    reference, test = (np.asarray(image, dtype=np.float32) for image in (target, render))
    errors = np.zeros(target.shape[:2])
    part, reached = (_around_differences(reference, test, reach) for reach in (2 * _FLIP_REACH, _FLIP_REACH))
    if part is None or reached is None:
        return errors
    # The implementation writes into the dictionary of parameters, so each call gets a new one.
    found, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference[part]),
        np.ascontiguousarray(test[part]),
        "LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={},
    )
    inside = tuple(slice(inner.start - outer.start, inner.stop - outer.start) for outer, inner in zip(part, reached, strict=True))
    errors[reached] = found[..., 0][inside]
    return errors


def flip(target: Image, render: Image) -> float:
    """Mean of :func:`flip_map`, in [0, 1]; lower is better."""
    return float(flip_map(target, render).mean())


def alpha_iou(target: Image, render: Image) -> float:
    """Intersection over union of the silhouettes (alpha >= 0.5) of two RGBA pictures, in [0, 1], 1 for two empty ones; higher is better."""
    check_shape("target", target.shape, (None, None, 4))
    check_shape("render", render.shape, target.shape)
    inside_render, inside_target = (picture[..., 3] >= ALPHA_THRESHOLD for picture in (render, target))
    union = np.count_nonzero(inside_render | inside_target)
    return np.count_nonzero(inside_render & inside_target) / union if union else 1.0


def silhouette_distance(target: Image, render: Image) -> float:
    """The 95 % Hausdorff distance between the silhouettes (alpha >= 0.5) of two RGBA pictures in pixels; lower is better.

    95 % of the pixels of either silhouette are within this distance of a pixel of the other; gaps in a silhouette count (Huttenlocher et
    al. 1993, "Comparing images using the Hausdorff distance", section II-C, the larger of both directions). Two empty silhouettes have
    distance 0; an empty one and another have the length of the picture's diagonal.
    """
    from scipy.ndimage import distance_transform_edt

    check_shape("target", target.shape, (None, None, 4))
    check_shape("render", render.shape, target.shape)
    inside_render, inside_target = (picture[..., 3] >= ALPHA_THRESHOLD for picture in (render, target))
    if not inside_render.any() or not inside_target.any():
        return math.hypot(*target.shape[:2]) if inside_render.any() or inside_target.any() else 0.0
    distances = [distance_transform_edt(~b)[a] for a, b in ((inside_render, inside_target), (inside_target, inside_render))]
    return max(float(np.quantile(each, _HAUSDORFF_SHARE, method="inverted_cdf")) for each in distances)


def sharpness(target: Image, render: Image) -> float | None:
    """Ratio of the mean absolute gradients of render and target, two RGB pictures: 1 is as sharp, below is blurred, above is noisy.

    The gradient is the difference of neighboring pixels, across and down, averaged over both directions and over RGB. ``None`` for a
    flat target.
    """
    check_shape("render", render.shape, target.shape)
    return _ratio(_mean_gradient(render), _mean_gradient(target))


def color_sum(picture: Image, where: NDArray[np.bool_] | None = None) -> ColorSum:
    """Sums of premultiplied RGB and of alpha over a premultiplied RGBA picture, or over its pixels ``where`` [H, W]."""
    check_shape("picture", picture.shape, (None, None, 4))
    red, green, blue, alpha = (picture.reshape(-1, 4) if where is None else picture[where]).sum(0, dtype=np.float64).tolist()
    return red, green, blue, alpha


def mean_color(total: ColorSum) -> tuple[float, float, float] | None:
    """The mean RGB color of what is visible, in [0, 1]: sums of premultiplied RGB over the sum of alpha; ``None`` if nothing is visible."""
    *rgb, alpha = total
    if not alpha > 0:
        return None
    red, green, blue = (min(max(value / alpha, 0.0), 1.0) for value in rgb)
    return red, green, blue


def color_difference(target: ColorSum, render: ColorSum) -> float | None:
    """CIE 1976 distance (dE*ab) of the mean colors of two pictures, from display-referred sRGB under D65; 0 is best, about 2.3 is just
    noticeable. ``None`` if a picture is empty."""
    labs = [_lab(color) for total in (target, render) if (color := mean_color(total)) is not None]
    return float(np.linalg.norm(labs[1] - labs[0])) if len(labs) == 2 else None


def chroma_ratio(target: ColorSum, render: ColorSum) -> float | None:
    """CIELAB chroma of the render's mean color over that of the target's: 1 is as colorful, below is paler.

    ``None`` if a picture is empty or the target is gray.
    """
    chromas = [float(np.hypot(*_lab(color)[1:])) for total in (target, render) if (color := mean_color(total)) is not None]
    return chromas[1] / chromas[0] if len(chromas) == 2 and chromas[0] > _GRAY_CHROMA else None


def brightness_ratio(target: ColorSum, render: ColorSum) -> float | None:
    """Mean over RGB of the render's mean color over that of the target's: 1 is as bright, below is darker.

    Transparency does not count as darkness. ``None`` if a picture is empty or the target is black.
    """
    colors = [color for total in (target, render) if (color := mean_color(total)) is not None]
    return sum(colors[1]) / sum(colors[0]) if len(colors) == 2 and sum(colors[0]) > _BLACK else None


def brightness(target: Image, render: Image) -> float | None:
    """Ratio of the mean colors of render and target inside the target's silhouette: 1 is as bright, below is darker.

    The colors are premultiplied RGB, as over black, so holes in the render darken it too, unlike in :func:`brightness_ratio`. The
    silhouette is where the target's alpha >= 0.5. ``None`` if the silhouette is empty or black.
    """
    check_shape("target", target.shape, (None, None, 4))
    check_shape("render", render.shape, target.shape)
    inside = target[..., 3] >= ALPHA_THRESHOLD
    if not inside.any():
        return None
    return _ratio(*(float(image[inside, :3].mean(dtype=np.float64)) for image in (render, target)))


def _around_differences(target: Image, render: Image, margin: int) -> tuple[slice, slice] | None:
    """Rows and columns of the rectangle around the pixels that differ, with a margin inside the picture; ``None`` for equal pictures."""
    differs = (target != render).any(-1)
    if not differs.any():
        return None
    lines = (np.flatnonzero(differs.any(axis)) for axis in (1, 0))
    rows, columns = (
        slice(max(int(line[0]) - margin, 0), min(int(line[-1]) + margin + 1, side)) for line, side in zip(lines, differs.shape, strict=True)
    )
    return rows, columns


def _lab(color: tuple[float, float, float]) -> NDArray[np.float64]:
    """CIELAB of a display-referred sRGB color under D65, [3]."""
    from skimage.color import rgb2lab

    return np.asarray(rgb2lab(np.array(color, dtype=np.float64)), dtype=np.float64)


def _mean_gradient(image: Image) -> float:
    image = image.astype(np.float64)
    return float((np.abs(np.diff(image, axis=0)).mean() + np.abs(np.diff(image, axis=1)).mean()) / 2)


def _ratio(value: float, reference: float) -> float | None:
    return value / reference if reference > 0 else None
