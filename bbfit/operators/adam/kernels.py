"""Warp kernel for Adam on blocks of texels; one source for the CPU and CUDA.

Step t of Adam (Kingma and Ba 2015, algorithm 1, with the corrections of section 2 moved out of the loop) is, for a gradient g,

    m <- beta1 m + (1 - beta1) g,    v <- beta2 v + (1 - beta2) g^2,
    x <- x - rate / (1 - beta1^t) m / (sqrt(v) / sqrt(1 - beta2^t) + epsilon).

**Rest.** A block without a gradient for k steps has m = beta1^k m_0. Once beta1^k is below 1.4e-6 it hardly moves, so its texels and
moments are left alone. When it has a gradient again, the moments are multiplied by the powers of beta1 and beta2 that were left out:
memory is read for blocks that some view shows, and not for all.

**Alpha's own loss.** Over texels with alpha > 0, the sum of binarization alpha (1 - alpha) + sparsity alpha has the derivative
binarization (1 - 2 alpha) + sparsity, which is added to the gradient.
"""

# mypy: ignore-errors

import warp as wp

from bbfit.operators.drawing.tile_forward import BLOCK
from bbfit.operators.launching import FLAGS

texel_block = wp.types.vector(length=4 * BLOCK, dtype=wp.float32)
"""A block of RGBA texels, which fills a CPU's vector registers."""

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})


@wp.struct
class Step:
    """The numbers of a step (:meth:`bbfit.operators.adam.fused.AdamFused.update`)."""

    index: int
    rate: float
    beta1: float
    beta2: float
    correction: float
    epsilon: float
    rest_after: int
    binarization: float
    sparsity: float
    alpha_rate: float


@wp.func_native(f"""
    constexpr int SIZE = {4 * BLOCK};
    float *g = gradient.data[i].c, *p = texels.data[i].c, *m = first_moment.data[i].c, *v = second_moment.data[i].c;
    float slope[SIZE], texel[SIZE], first[SIZE], second[SIZE];
    int bits = 0, opaque = 0;
    for (int c = 0; c < SIZE; ++c) {{
        slope[c] = g[c];
        bits |= ((const int*)g)[c] & 0x7fffffff;
    }}
    const int idle = step.index - last.data[i];
    if (!bits && idle > step.rest_after) return;
    float decay1 = step.beta1, decay2 = step.beta2;
    if (bits) {{
        last.data[i] = step.index;
        for (int c = 0; c < SIZE; ++c) g[c] = 0.0f;
        if (idle > step.rest_after) {{
            decay1 = powf(step.beta1, idle - step.rest_after);
            decay2 = powf(step.beta2, idle - step.rest_after);
        }}
    }}
    for (int c = 0; c < SIZE; ++c) {{
        const bool alpha = (c & 3) == 3;
        const float own = step.binarization * (1.0f - 2.0f * p[c]) + step.sparsity;
        slope[c] += (alpha & (p[c] > 0.0f)) ? own : 0.0f;
        first[c] = m[c] * decay1 + slope[c] * (1.0f - step.beta1);
        second[c] = v[c] * decay2 + slope[c] * slope[c] * (1.0f - step.beta2);
        const float rate = alpha ? step.rate * step.alpha_rate : step.rate;
        const float moved = p[c] - rate * first[c] / (sqrtf(second[c]) * step.correction + step.epsilon);
        const float least = moved > 0.0f ? moved : 0.0f;
        texel[c] = least < 1.0f ? least : 1.0f;
        opaque |= alpha & (texel[c] > 0.0f);
    }}
    for (int c = 0; c < SIZE; ++c) {{
        p[c] = texel[c];
        m[c] = first[c];
        v[c] = second[c];
    }}
    occupied.data[i] = opaque;
""")
def update_block(
    i: int,
    step: Step,
    texels: wp.array(dtype=texel_block),
    gradient: wp.array(dtype=texel_block),
    first_moment: wp.array(dtype=texel_block),
    second_moment: wp.array(dtype=texel_block),
    last: wp.array(dtype=wp.int32),
    occupied: wp.array(dtype=wp.uint8),
):
    """Take a step for block ``i``, whose numbers stay in registers."""


@wp.kernel(launch_bounds=(256, 4))
def update_blocks(
    first: int,
    run: int,
    step: Step,
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
        update_block(i, step, texels, gradient, first_moment, second_moment, last, occupied)
