"""Warp kernels for the losses of a pixel; one source for the CPU and CUDA.

**Forward.** With the difference d = (c, a) of premultiplied color and alpha, a pixel's loss is

    l1: sum of |d|,    l2: sum of d^2,    backgrounds: sum of c^2 + a^2 - a sum of c

(:func:`~bbfit.operators.image_loss.reference.pixel_loss_reference`).

**Backward.** The derivatives in the render are sign(d), 2 d, and for ``backgrounds``

    by c_i: 2 c_i - a,    by a: 2 a - sum of c.

The backward pass of drawing (:mod:`bbfit.operators.drawing.tile_kernels`) compares its pixels with the code here. It therefore needs no
picture in memory.
"""

# mypy: ignore-errors

import warp as wp

from bbfit.operators.launching import FLAGS, PIXEL

LOSSES = {"l1": 1, "l2": 2, "backgrounds": 3}
"""Numbers of the losses in kernels; 0 is none."""
ROUNDING = 5e-7
"""Difference of values in [0, 1] that may be due to rounding. Its sign is 0."""
Pixels = wp.array(dtype=wp.vec4)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})

COMPARISON = f"""{PIXEL}
    constexpr float ROUNDING = {ROUNDING!r}f;
    // A pixel of 8-bit RGBA, straight or premultiplied, as premultiplied floats. It is divided, so that 255 is exactly 1.
    auto premultiplied = [](int packed, int straight) -> pixel {{
        pixel p;
        for (int c = 0; c < 4; ++c) p[c] = (float)(packed >> 8 * c & 255) / 255.0f;
        const float alpha = p[3];
        if (straight) p = p * alpha;
        p[3] = alpha;
        return p;
    }};
    // The loss of a pixel with the difference d from its target. Adds `weight` times the derivative to g.
    auto pixel_loss = [](pixel d, int loss, float weight, pixel& g) -> float {{
        if (loss == {LOSSES["l1"]}) {{
            float total = 0.0f;
            for (int c = 0; c < 4; ++c) {{
                total += fabsf(d[c]);
                g[c] += d[c] > ROUNDING ? weight : d[c] < -ROUNDING ? -weight : 0.0f;
            }}
            return total;
        }}
        const pixel squares = d * d;
        const float total = squares[0] + squares[1] + squares[2] + squares[3], colors = d[0] + d[1] + d[2];
        g = g + d * (2.0f * weight);
        if (loss == {LOSSES["l2"]}) return total;
        g = g - pixel{{d[3], d[3], d[3], colors}} * weight;
        return total - d[3] * colors;
    }};
"""
"""C++ of native functions that compare pixels."""


@wp.func_native(f"""{COMPARISON}
    ONE_BY_ONE
    for (int i = begin; i < end; ++i) ((pixel*)image.data)[i] = premultiplied(packed.data[i], straight);
""")
def unpack_run(packed: wp.array(dtype=wp.int32), straight: int, image: Pixels, begin: int, end: int):
    """Write the pixels ``begin`` to ``end``."""


@wp.func_native(f"""{COMPARISON}
    losses.data[i] = pixel_loss(((pixel*)render.data)[i] - ((pixel*)target.data)[i], loss, weight, ((pixel*)gradient.data)[i]);
""")
def compare_pixel(i: int, loss: int, weight: float, render: Pixels, target: Pixels, gradient: Pixels, losses: wp.array(dtype=wp.float32)):
    """Compare pixel ``i``."""


@wp.kernel
def unpack(first: int, run: int, packed: wp.array(dtype=wp.int32), straight: int, image: Pixels):
    """Write 8-bit RGBA [P] as premultiplied floats; launched over runs of pixels, from run ``first`` on."""
    tid, _ = wp.tid()
    begin = (first + tid) * run
    unpack_run(packed, straight, image, begin, wp.min(begin + run, packed.shape[0]))


@wp.kernel
def compare(loss: int, weight: float, render: Pixels, target: Pixels, gradient: Pixels, losses: wp.array(dtype=wp.float32)):
    """Write the loss of every pixel [P] and add its derivative, times ``weight``, to ``gradient`` [P]; launched over pixels."""
    compare_pixel(wp.tid(), loss, weight, render, target, gradient, losses)
