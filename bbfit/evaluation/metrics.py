"""Differences between the render and the target of one view, with a data range of 1.

All functions take the target first and return a ``float`` that is summed in float64. "Over white" pictures are RGB [H, W, 3] composited
over white (:func:`bbfit.images.over_color`), the others premultiplied RGBA [H, W, 4]; both hold display-referred values in [0, 1].

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

MSE_FLOOR = 1e-12
"""Smallest mean squared error in a logarithm: a root mean square of one millionth of the data range."""
SSIM_WINDOW = 11
"""Side of the SSIM window in pixels, which is the side of the smallest picture that can be measured."""
ALPHA_THRESHOLD = 0.5
"""Smallest alpha of a pixel of the silhouette."""
_HAUSDORFF_SHARE = 0.95


def mean_squared_error(target: Image, render: Image) -> float:
    """Mean of the squared differences over all pixels and channels; pictures of any equal shape."""
    check_shape("render", render.shape, target.shape)
    return float(np.square(np.subtract(target, render, dtype=np.float64)).mean())


def root_mean_squared_error(target: Image, render: Image) -> float:
    """Square root of :func:`mean_squared_error`, in [0, 1]; lower is better."""
    return float(np.sqrt(mean_squared_error(target, render)))


def psnr(target: Image, render: Image) -> float:
    """Peak signal-to-noise ratio in dB, at most 120; higher is better: ``-10 log10(mse)`` with one error over all pixels and channels."""
    return float(-10 * np.log10(max(mean_squared_error(target, render), MSE_FLOOR)))


def ssim(target: Image, render: Image) -> float:
    """Structural similarity over white, in [-1, 1]; higher is better (Wang et al. 2004).

    Gaussian window of 11 x 11 pixels with a standard deviation of 1.5, as in the paper's section III-C; the mean over channels and over the
    pixels whose window lies inside the picture. Raises InputError if a side of the picture is shorter than the window.
    """
    from skimage.metrics import structural_similarity

    check_shape("render", render.shape, target.shape)
    check_size(target.shape[1], target.shape[0])
    value = structural_similarity(
        target.astype(np.float64),
        render.astype(np.float64),
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        truncate=3.5,  # 3.5 standard deviations reach five pixels to each side: 11 taps
        use_sample_covariance=False,
    )
    return float(value)


def check_size(width: int, height: int) -> None:
    """Raise InputError for pictures with a side shorter than the SSIM window."""
    if min(width, height) < SSIM_WINDOW:
        fail(
            "views",
            f"pictures of {width} x {height} pixels are too small to measure",
            f"SSIM needs at least {SSIM_WINDOW} x {SSIM_WINDOW}; render larger views",
        )


def flip_map(target: Image, render: Image) -> NDArray[np.float64]:
    """Perceived difference of each pixel over white, [H, W] in [0, 1] (Andersson et al. 2020, "FLIP").

    For a viewer at 67 pixels a degree (0.7 m from a screen of 3840 pixels on 0.7 m), the default of the authors' implementation.
    """
    import flip_evaluator

    check_shape("target", target.shape, (None, None, 3))
    check_shape("render", render.shape, target.shape)
    reference, test = (np.ascontiguousarray(image, dtype=np.float32) for image in (target, render))
    # The implementation writes into the dictionary of parameters, so each call gets a new one.
    errors, _, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False, parameters={})
    return np.asarray(errors[..., 0], dtype=np.float64)


def flip(target: Image, render: Image) -> float:
    """Mean of :func:`flip_map` over white, in [0, 1]; lower is better."""
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
    """Ratio of the mean absolute gradients of render and target over white: 1 is as sharp, below is blurred, above is noisy.

    The gradient is the difference of neighboring pixels, across and down, averaged over both directions and over RGB. ``None`` for a
    flat target.
    """
    check_shape("render", render.shape, target.shape)
    return _ratio(_mean_gradient(render), _mean_gradient(target))


def brightness(target: Image, render: Image) -> float | None:
    """Ratio of the mean colors of render and target inside the target's silhouette: 1 is as bright, below is darker.

    The colors are premultiplied RGB, as over black, so holes in the render darken it too. The silhouette is where the target's
    alpha >= 0.5. ``None`` if the silhouette is empty or black.
    """
    check_shape("target", target.shape, (None, None, 4))
    check_shape("render", render.shape, target.shape)
    inside = target[..., 3] >= ALPHA_THRESHOLD
    if not inside.any():
        return None
    return _ratio(*(float(image[inside, :3].mean(dtype=np.float64)) for image in (render, target)))


def _mean_gradient(image: Image) -> float:
    image = image.astype(np.float64)
    return float((np.abs(np.diff(image, axis=0)).mean() + np.abs(np.diff(image, axis=1)).mean()) / 2)


def _ratio(value: float, reference: float) -> float | None:
    return value / reference if reference > 0 else None
