"""How much a render differs from its target, one view at a time, on the honest scale: data range 1.

All functions take the target first and give a plain ``float`` summed in float64. "Over white" pictures are RGB [H, W, 3] composited
over white (:func:`bbfit.images.over_color`), the others premultiplied RGBA [H, W, 4]; both hold display-referred values in [0, 1].

No result is infinite or NaN, so that every one can stand in a JSON file. A mean squared error counts as at least :data:`MSE_FLOOR`, so
identical pictures have a PSNR of 120 dB. A ratio to something that the target does not have (the sharpness of a flat picture, the
brightness of an empty or black silhouette) is ``None`` and takes no part in averages.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import check_shape, fail

Image = NDArray[np.floating[Any]]

MSE_FLOOR = 1e-12
"""Least mean squared error that enters a logarithm: a root mean square of one millionth of the data range."""
SSIM_WINDOW = 11
"""Side of the SSIM window in pixels, and so the smallest picture that can be measured."""
ALPHA_THRESHOLD = 0.5
"""Alpha from which on a pixel belongs to the silhouette."""
_HAUSDORFF_SHARE = 0.95


def mean_squared_error(target: Image, render: Image) -> float:
    """Mean of the squared differences over all pixels and channels; pictures of any equal shape."""
    check_shape("render", render.shape, target.shape)
    return float(np.square(np.subtract(target, render, dtype=np.float64)).mean())


def root_mean_squared_error(target: Image, render: Image) -> float:
    """Square root of :func:`mean_squared_error`, in [0, 1]; lower is better."""
    return float(np.sqrt(mean_squared_error(target, render)))


def psnr(target: Image, render: Image) -> float:
    """Peak signal-to-noise ratio in dB for data range 1, at most 120; higher is better.

    ``-10 log10(mse)``, where one mean squared error is taken over all pixels and channels.
    """
    return float(-10 * np.log10(max(mean_squared_error(target, render), MSE_FLOOR)))


def ssim(target: Image, render: Image) -> float:
    """Structural similarity over white, in [-1, 1]; higher is better (Wang et al. 2004).

    Gaussian window of 11 x 11 pixels with a standard deviation of 1.5, as in the paper's section III-C; the mean over channels and over
    the pixels whose window lies inside the picture.

    Raises
    ------
    InputError
        if a side of the picture is shorter than the window.
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
    """Require pictures that the SSIM window fits into."""
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
    # The implementation keeps what it used in the dictionary of parameters, so it gets a new one each time.
    errors, _, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False, parameters={})
    return np.asarray(errors[..., 0], dtype=np.float64)


def flip(target: Image, render: Image) -> float:
    """Mean of :func:`flip_map` over white, in [0, 1]; lower is better."""
    return float(flip_map(target, render).mean())


def alpha_iou(target: Image, render: Image) -> float:
    """Intersection over union of the silhouettes (alpha >= 0.5) of two RGBA pictures, in [0, 1]; higher is better.

    Two empty silhouettes agree: 1.
    """
    check_shape("target", target.shape, (None, None, 4))
    check_shape("render", render.shape, target.shape)
    ours, theirs = render[..., 3] >= ALPHA_THRESHOLD, target[..., 3] >= ALPHA_THRESHOLD
    union = np.count_nonzero(ours | theirs)
    return np.count_nonzero(ours & theirs) / union if union else 1.0


def silhouette_distance(target: Image, render: Image) -> float:
    """How far apart the silhouettes (alpha >= 0.5) of two RGBA pictures are, in pixels; lower is better.

    The 95 % Hausdorff distance: so near to a pixel of the other silhouette, gaps within it taken into account, are 95 of 100 pixels of
    either one (Huttenlocher et al. 1993, "Comparing images using the Hausdorff distance", section II-C, with the worse direction).
    Two empty silhouettes are 0 apart; an empty one and another are the picture's diagonal apart.
    """
    from scipy.ndimage import distance_transform_edt

    check_shape("target", target.shape, (None, None, 4))
    check_shape("render", render.shape, target.shape)
    ours, theirs = render[..., 3] >= ALPHA_THRESHOLD, target[..., 3] >= ALPHA_THRESHOLD
    if not ours.any() or not theirs.any():
        return math.hypot(*target.shape[:2]) if ours.any() or theirs.any() else 0.0
    distances = [distance_transform_edt(~b)[a] for a, b in ((ours, theirs), (theirs, ours))]
    return max(float(np.quantile(each, _HAUSDORFF_SHARE, method="inverted_cdf")) for each in distances)


def sharpness(target: Image, render: Image) -> float | None:
    """Mean absolute gradient of the render over that of the target, over white: 1 is as sharp, below is blurred, above is noisy.

    The gradient is the difference of neighboring pixels, across and down, averaged over both directions and over RGB. ``None`` for a
    flat target.
    """
    check_shape("render", render.shape, target.shape)
    return _ratio(_mean_gradient(render), _mean_gradient(target))


def brightness(target: Image, render: Image) -> float | None:
    """Mean color of the render inside the target's silhouette over that of the target: 1 is as bright, below is darker.

    On the premultiplied RGB of two RGBA pictures (what is seen over black), so holes in the render darken it too. The silhouette is where
    the target's alpha >= 0.5. ``None`` if the silhouette is empty or black.
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
