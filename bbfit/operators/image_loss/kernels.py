"""Warp kernels for the losses of a pixel; one source for the CPU and CUDA.

**Forward.** With the difference d = (c, a) of premultiplied color and alpha, a pixel's loss is

    l1: sum of |d|,    l2: sum of d^2,    backgrounds: sum of c^2 + a^2 - a sum of c

(:func:`~bbfit.operators.image_loss.reference.pixel_loss_reference`).

**Backward.** The derivatives in the render are sign(d), 2 d, and for ``backgrounds``

    by c_i: 2 c_i - a,    by a: 2 a - sum of c.

The function :func:`add_pixel_loss` is called for every pixel of a picture by the kernel here, and by the backward pass of drawing
(:mod:`bbfit.operators.drawing.kernels`), which therefore needs no picture in memory.
"""

# mypy: ignore-errors

import warp as wp

from bbfit.operators.launching import FLAGS

LOSSES = {"l1": 1, "l2": 2, "backgrounds": 3}
"""Numbers of the losses in kernels; 0 is none."""
L1, BACKGROUNDS = wp.constant(LOSSES["l1"]), wp.constant(LOSSES["backgrounds"])
ROUNDING = 5e-7
Pixels = wp.array(dtype=wp.vec4)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.func
def premultiplied(packed: int, straight: int) -> wp.vec4:
    """A pixel of 8-bit RGBA as premultiplied floats."""
    alpha = float((packed >> 24) & 255) / 255.0  # divided, so that 255 is exactly 1
    scale = wp.where(straight != 0, alpha, 1.0)
    red = float(packed & 255) / 255.0
    green = float((packed >> 8) & 255) / 255.0
    blue = float((packed >> 16) & 255) / 255.0
    return wp.vec4(red * scale, green * scale, blue * scale, alpha)


@wp.func
def sign(x: float) -> float:
    """-1, 0 or 1; 0 for what may be the rounding error of a difference of values in [0, 1]. Warp's own sign of zero is 1."""
    return wp.where(x > wp.static(ROUNDING), 1.0, wp.where(x < wp.static(-ROUNDING), -1.0, 0.0))


@wp.func
def add_pixel_loss(d: wp.vec4, loss: int, weight: float, total: float, g: wp.vec4):
    """``total`` plus the loss of a difference ``d``, and ``g`` plus ``weight`` times the derivative."""
    if loss == L1:
        total += wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2]) + wp.abs(d[3])
        g += wp.vec4(sign(d[0]), sign(d[1]), sign(d[2]), sign(d[3])) * weight
    else:
        total += wp.dot(d, d)
        g += d * (2.0 * weight)
        if loss == BACKGROUNDS:
            colors = d[0] + d[1] + d[2]
            total -= d[3] * colors
            g -= wp.vec4(d[3], d[3], d[3], colors) * weight
    return total, g


@wp.func
def color_slope(color: wp.vec3, seen: wp.vec4) -> wp.vec3:
    """Derivative of A |c - C|^2 in a layer's straight color c, for a view's premultiplied pixel (A C, A)."""
    return (color * seen[3] - wp.vec3(seen[0], seen[1], seen[2])) * 2.0


@wp.kernel
def unpack(first: int, run: int, packed: wp.array(dtype=wp.int32), straight: int, image: Pixels):
    """Write 8-bit RGBA [P] as premultiplied floats; launched over runs of pixels, from run ``first`` on."""
    tid, _ = wp.tid()
    begin = (first + tid) * run
    i = int(begin)
    while i < wp.min(begin + run, packed.shape[0]):
        image[i] = premultiplied(packed[i], straight)
        i += 1


@wp.kernel
def compare(loss: int, weight: float, render: Pixels, target: Pixels, gradient: Pixels, losses: wp.array(dtype=wp.float32)):
    """Write the loss of every pixel [P] and add its derivative, times ``weight``, to ``gradient`` [P]; launched over pixels."""
    i = wp.tid()
    total, g = add_pixel_loss(render[i] - target[i], loss, weight, 0.0, gradient[i])
    losses[i] = total
    gradient[i] = g
