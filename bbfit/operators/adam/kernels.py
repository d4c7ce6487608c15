"""Warp kernel for Adam on blocks of texels; one source for the CPU and CUDA.

Step t of Adam (Kingma and Ba 2015, algorithm 1, with the corrections of section 2 moved out of the loop) is, for a gradient g,

    m <- beta1 m + (1 - beta1) g,    v <- beta2 v + (1 - beta2) g^2,
    x <- x - rate / (1 - beta1^t) m / (sqrt(v) / sqrt(1 - beta2^t) + epsilon).

**Rest.** A block without a gradient for k steps has m = beta1^k m_0. Once beta1^k is below 1.4e-6 it hardly moves, so its texels and
moments are left alone. When it has a gradient again, the moments are multiplied by the powers of beta1 and beta2 that were left out:
memory is read for blocks that some view shows, and not for all.

**Binarization.** The sum of alpha (1 - alpha) over texels with alpha > 0 has the derivative 1 - 2 alpha, which is added to the gradient.
"""

# mypy: ignore-errors

import warp as wp

from bbfit.operators.drawing.tile_kernels import BLOCK
from bbfit.operators.launching import FLAGS

texel_block = wp.types.vector(length=4 * BLOCK, dtype=wp.float32)
"""A block of RGBA texels, which fills a CPU's vector registers."""

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.kernel
def update_blocks(
    first: int,
    run: int,
    step: int,
    rate: float,
    beta1: float,
    beta2: float,
    correction: float,
    epsilon: float,
    rest_after: int,
    binarization: float,
    alpha_rate: float,
    texels: wp.array(dtype=texel_block),
    gradient: wp.array(dtype=texel_block),
    first_moment: wp.array(dtype=texel_block),
    second_moment: wp.array(dtype=texel_block),
    last: wp.array(dtype=wp.int32),
    occupied: wp.array(dtype=wp.uint8),
):
    """Take a step; launched over runs of ``run`` blocks, from run ``first`` on. Clears ``gradient``, updates ``occupied``."""
    tid, _ = wp.tid()
    begin = (first + tid) * run
    for i in range(begin, wp.min(begin + run, texels.shape[0])):
        g = gradient[i]
        idle = step - last[i]
        moved = wp.dot(g, g) != 0.0
        if moved or idle <= rest_after:
            decay1 = beta1
            decay2 = beta2
            if moved:
                gradient[i] = texel_block()
                last[i] = step
                if idle > rest_after:
                    decay1 = wp.pow(beta1, float(idle - rest_after))
                    decay2 = wp.pow(beta2, float(idle - rest_after))
            p = texels[i]
            if binarization != 0.0:
                for t in range(wp.static(BLOCK)):
                    alpha = p[4 * t + 3]
                    if alpha > 0.0:
                        g[4 * t + 3] += binarization * (1.0 - 2.0 * alpha)
            m = first_moment[i] * decay1 + g * (1.0 - beta1)
            v = second_moment[i] * decay2 + wp.cw_mul(g, g) * (1.0 - beta2)
            first_moment[i] = m
            second_moment[i] = v
            for c in range(wp.static(4 * BLOCK)):
                of_channel = wp.where((c & 3) == 3, rate * alpha_rate, rate)
                p[c] = wp.clamp(p[c] - of_channel * m[c] / (wp.sqrt(v[c]) * correction + epsilon), 0.0, 1.0)
            texels[i] = p
            opaque = p[3] + p[7] + p[11] + p[15]
            occupied[i] = wp.where(opaque > 0.0, wp.uint8(1), wp.uint8(0))
