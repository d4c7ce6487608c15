"""Warp functions for a tile of pixels and the layers that it meets; one source for the CPU and CUDA.

A tile has 2 rows of 8 pixels on a CPU, which fill its vector registers, and one pixel on CUDA. Its layers go through these functions:

1. :func:`meet` computes texel coordinates, and :func:`arrange` sorts the layers of each pixel.
2. :func:`sample` filters a layer's texture for all pixels. A sample at texel (i + fx, j + fy) is S = sum over its four texels of w_c t_c with
   the bilinear weights w = (1 - fx)(1 - fy), fx (1 - fy), (1 - fx) fy, fx fy. Alpha is 0 in texels beyond the border.
3. :func:`blend` composites a layer.
4. :func:`pull_back` differentiates the picture in the samples, and :func:`scatter` the samples in the texels: for a derivative g in S, texel c
   receives w_c g. The derivative in the texel coordinates is, with the products k_c = t_c . g,

    by u: (k_1 - k_0)(1 - fy) + (k_3 - k_2) fy,    by v: (k_2 - k_0)(1 - fx) + (k_3 - k_1) fx.

**Order.** Layers begin in the order that they have in the tile to the left, which is mostly right, and are sorted by insertion, all pixels at
a time.

**Opacity** is a step or a ramp of filtered alpha (:func:`bbfit.operators.drawing.compositing.opacity`). The contrast of an antialiased mask
compares pixels of a square of 2 x 2; a tile of a CPU has them all. Where a ramp is steeper than
:data:`~bbfit.operators.drawing.compositing.STEEPEST`, its derivative is a straight-through estimate.

The functions are written in C++: Warp copies an array that is an element of a structure before it reads or changes one of its numbers.
"""

# mypy: ignore-errors

from functools import cache
from types import SimpleNamespace

import warp as wp

from bbfit.operators.drawing.compositing import HASH, LEAST_CONTRAST, STEEPEST, TIE
from bbfit.operators.launching import FLAGS, PIXEL

BLOCK = 4
"""Consecutive texels that share one byte of occupancy and that Adam updates together."""
REACH = 26
"""Largest distance of the texels that a row of pixels in a tile reads, for a test of occupancy."""
HASHED, BLENDED = -1.0, 0.0
"""Cutoffs of alpha modes that have none."""
SMOOTH, COVERAGE = 1.0, 2.0
"""An antialiased mask, and coverage, in the last place of an encoded alpha mode."""

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FLAGS})

@wp.struct
class Plane:
    """A billboard in a view (:class:`bbfit.operators.drawing.projection.Projection`)."""

    to_texel: wp.mat33
    nearness: wp.vec3
    texture: wp.vec3i
    box: wp.vec4i


# MISS: a pixel misses a plane. BORDER: some of a sample's four texels lie beyond the texture's border.
_CONSTANTS = f"""
    constexpr int MISS = -1, BORDER = -2, BLOCK = {BLOCK}, REACH = {REACH};
    constexpr unsigned HASH[] = {{{", ".join(f"{factor}u" for factor in HASH)}}};
    constexpr float TIE = {TIE!r}f, STEEPEST = {STEEPEST!r}f, LEAST_CONTRAST = {LEAST_CONTRAST!r}f;
    constexpr float HASHED = {HASHED!r}f, BLENDED = {BLENDED!r}f, SMOOTH = {SMOOTH!r}f, COVERAGE = {COVERAGE!r}f;
"""
# Adds to a texel's gradient.
_ADD = """
#if defined(__CUDA_ARCH__)
    auto add = [&](int i, pixel by) { wp::atomic_add(gradient.data + i, wp::vec_t<4, wp::float32>(by[0], by[1], by[2], by[3])); };
#else
    auto add = [&](int i, pixel by) { ((pixel*)gradient.data)[i] += by; };
#endif
"""
# The four texels around a sample at texel coordinates (u, v) that may lie beyond the border, clamped to it, and their weights.
_CORNERS = """
    struct corners { int at[4]; bool there[4]; float weights[4]; };
    auto around = [](float u, float v, int first, int height, int width) -> corners {
        const float left = floorf(u), top = floorf(v), fx = u - left, fy = v - top;
        corners found;
        for (int c = 0; c < 4; ++c) {
            const int x = (int)left + (c & 1), y = (int)top + (c >> 1);
            const int near_x = x < 0 ? 0 : x < width ? x : width - 1, near_y = y < 0 ? 0 : y < height ? y : height - 1;
            found.at[c] = first + near_y * width + near_x;
            found.there[c] = x == near_x && y == near_y;
            found.weights[c] = ((c & 1) ? fx : 1.0f - fx) * ((c >> 1) ? fy : 1.0f - fy);
        }
        return found;
    };
"""


_RESTART = """
    tile.count = count;
    for (int n = 0; n < count; ++n) tile.listed.c[n] = n;
"""
_MEET = """
    float xs[LANES], ys[LANES];
    for (int l = 0; l < LANES; ++l) {
        xs[l] = (float)(column + l % COLUMNS);
        ys[l] = (float)(row + l / COLUMNS);
    }
    int k = 0;
    for (int slot = 0; slot < tile.count; ++slot) {
        const int id = tile.listed.c[slot];
        const auto plane = planes.data[base + id];
        const int* box = plane.box.c;
        const bool above = row + LANES / COLUMNS <= box[2], below = row > box[3];
        if (above || below || column + COLUMNS <= box[0] || column > box[1] || box[0] > box[1]) continue;
        const auto& m = plane.to_texel.data;
        const int first = plane.texture.c[0], height = plane.texture.c[1], width = plane.texture.c[2];
        const float last_u = (float)width, last_v = (float)height;
        float nears[LANES], us[LANES], vs[LANES];
        int hits[LANES], any = 0;
        for (int l = 0; l < LANES; ++l) {
            const float w = m[2][0] * xs[l] + (m[2][1] * ys[l] + m[2][2]), scale = 1.0f / w;
            const float u = (m[0][0] * xs[l] + (m[0][1] * ys[l] + m[0][2])) * scale;
            const float v = (m[1][0] * xs[l] + (m[1][1] * ys[l] + m[1][2])) * scale;
            hits[l] = w > 0.0f & u > -1.0f & u < last_u & v > -1.0f & v < last_v;  // false for NaN
            nears[l] = w;
            us[l] = u;
            vs[l] = v;
        }
        if (orthographic) {
            const float* nearness = plane.nearness.c;
            for (int l = 0; l < LANES; ++l) {
                nears[l] = nearness[0] * xs[l] + (nearness[1] * ys[l] + nearness[2]);
                hits[l] &= nears[l] < 0.0f;
            }
        }
        for (int l = 0; l < LANES; ++l) any |= hits[l];
        if (!any) continue;
        int places[LANES];
        for (int l = 0; l < LANES; ++l) {
            const float u = hits[l] ? us[l] : -2.0f, v = hits[l] ? vs[l] : -2.0f, left = floorf(u), top = floorf(v);
            const bool inside = left >= 0.0f & left < last_u - 1.0f & top >= 0.0f & top < last_v - 1.0f;
            places[l] = inside ? first + (int)top * width + (int)left : hits[l] ? BORDER : MISS;
            us[l] = inside ? u - left : u;
            vs[l] = inside ? v - top : v;
        }
        for (int l = 0; l < LANES; ++l) {
            tile.place.data[k][l] = places[l];
            tile.fx.data[k][l] = us[l];
            tile.fy.data[k][l] = vs[l];
            tile.near.data[k][l] = nears[l];
            tile.order.data[k][l] = k;
        }
#if !defined(__CUDA_ARCH__)
        // Load into the cache what the tile below will probably read. The hardware does not predict jumps between rows of a texture.
        for (int l = COLUMNS - 1; l < LANES; l += COLUMNS) {
            const int ahead = places[l] + 2 * width;
            for (int by = 4 - 3 * BLOCK; by <= BLOCK && places[l] >= 0; by += BLOCK) {
                __builtin_prefetch(texels.data + ahead + by);
                if (gradient.data != texels.data) __builtin_prefetch(gradient.data + ahead + by);
            }
        }
#endif
        tile.slots.c[k] = slot;
        tile.ids.c[k] = id;
        tile.firsts.c[k] = first;
        tile.heights.c[k] = height;
        tile.widths.c[k] = width;
        tile.sampled.c[k] = 0;
        ++k;
    }
    tile.active = k;
    for (int l = 0; l < LANES; ++l) {
        tile.through.c[l] = 1.0f;
        for (int c = 0; c < 4; ++c) tile.color.data[l][c] = 0.0f;
    }
"""
_ARRANGE = """
    bool moved = false;
    for (int p = 0; p < tile.active; ++p) tile.same.c[p] = 1;
    for (int position = 1; position < tile.active; ++position) {
        for (int p = position; p > 0; --p) {
            float *front = tile.near.data[p - 1], *back = tile.near.data[p];
            int unsure = 0;
            for (int l = 0; l < LANES; ++l) unsure |= !(back[l] < front[l] - TIE * fabsf(front[l]));
            if (!unsure) break;
            int *i = tile.order.data[p - 1], *j = tile.order.data[p], changes = 0;
            for (int l = 0; l < LANES; ++l) {
                const float f = front[l], b = back[l];
                const int of_f = i[l], of_b = j[l];
                // Of layers of equal depth that of the lower plane is in front.
                const bool lower = tile.ids.c[of_f] < tile.ids.c[of_b];
                const bool swap = lower ? f < b - TIE * fabsf(b) : !(b < f - TIE * fabsf(f));
                front[l] = swap ? b : f;
                back[l] = swap ? f : b;
                i[l] = swap ? of_b : of_f;
                j[l] = swap ? of_f : of_b;
                changes += swap;
            }
            if (!changes) break;
            moved = true;
            if (changes < LANES) {
                tile.same.c[p - 1] = tile.same.c[p] = 0;
            } else {
                const int kept = tile.same.c[p - 1];
                tile.same.c[p - 1] = tile.same.c[p];
                tile.same.c[p] = kept;
            }
        }
    }
    if (moved) {
        int sorted[CAPACITY];
        for (int p = 0; p < tile.active; ++p) sorted[p] = tile.ids.c[tile.order.data[p][LANES - 1]];
        for (int k = 0; k < tile.active; ++k) tile.listed.c[tile.slots.c[k]] = sorted[k];
    }
"""
_SAMPLE = """
    for (int lane = 0; lane < (tile.same.c[position] ? 1 : LANES); ++lane) {
        const int k = tile.order.data[position][lane];
        if (tile.sampled.c[k]) continue;
        tile.sampled.c[k] = 1;
        const int first = tile.firsts.c[k], height = tile.heights.c[k], width = tile.widths.c[k];
        const int* place = tile.place.data[k];
        const float *fx = tile.fx.data[k], *fy = tile.fy.data[k];
        pixel* samples = (pixel*)tile.samples.data[k * LANES];
        float *alpha = tile.opacities.data[k], *slopes = tile.slopes.data[k];
        auto beyond = [&](float u, float v) -> pixel {
            const corners near = around(u, v, first, height, width);
            pixel sum = {0.0f, 0.0f, 0.0f, 0.0f};
            for (int c = 0; c < 4; ++c) {
                pixel t = *(const pixel*)(texels.data + near.at[c]);
                if (!near.there[c]) t[3] = 0.0f;
                sum = sum + t * near.weights[c];
            }
            return sum;
        };
        for (int begin = 0; begin < LANES; begin += COLUMNS) {
            bool inside = true, empty = false;
            for (int l = begin; l < begin + COLUMNS; ++l) inside &= place[l] >= 0;
            if (inside && shown) {
                const int i = place[begin], j = place[begin + COLUMNS - 1], least = i < j ? i : j, most = i < j ? j : i;
                if (most - least <= REACH) {
                    int any = 0;
                    for (int b = least / BLOCK; b <= (most + 1) / BLOCK; ++b) any |= occupied.data[b];
                    for (int b = (least + width) / BLOCK; b <= (most + 1 + width) / BLOCK; ++b) any |= occupied.data[b];
                    empty = !any;
                }
            }
            if (empty) {
                for (int l = begin; l < begin + COLUMNS; ++l) {
                    samples[l] = pixel{0.0f, 0.0f, 0.0f, 1.0f};
                    alpha[l] = 0.0f;
                }
                continue;
            }
            for (int l = begin; l < begin + COLUMNS; ++l) {
                pixel s = {0.0f, 0.0f, 0.0f, 0.0f};
                if (inside || place[l] >= 0) {
                    const pixel *p = (const pixel*)(texels.data + place[l]), *q = p + width;
                    const pixel upper = p[0] + (p[1] - p[0]) * fx[l], lower = q[0] + (q[1] - q[0]) * fx[l];
                    s = upper + (lower - upper) * fy[l];
                } else if (place[l] == BORDER) {
                    s = beyond(fx[l], fy[l]);
                }
                alpha[l] = s[3];
                s[3] = 1.0f;
                samples[l] = s;
            }
        }
        for (int l = 0; l < LANES; ++l) slopes[l] = 1.0f;
        if (test.c[3] == COVERAGE) {
            if (test.c[1] != 0.0f) {
                for (int l = 0; l < LANES; ++l) alpha[l] = floorf(alpha[l] * test.c[1] + 0.5f) / test.c[1];
            }
        } else if (test.c[0] == HASHED) {
            for (int l = 0; l < LANES; ++l) {  // bbfit.operators.drawing.compositing.thresholds
                unsigned h = unsigned(column + l % COLUMNS) * HASH[0] ^ unsigned(row + l / COLUMNS) * HASH[1] ^ unsigned(first) * HASH[2];
                h = (h ^ h >> 16) * HASH[3];
                h = (h ^ h >> 15) * HASH[4];
                h = h ^ h >> 16;
                alpha[l] = alpha[l] >= ((float)(h >> 9) + 0.5f) / 8388608.0f ? 1.0f : 0.0f;
            }
        } else if (test.c[0] != BLENDED) {
            float rates[LANES], gentle[LANES];
            for (int l = 0; l < LANES; ++l) {
                rates[l] = test.c[1];
                gentle[l] = test.c[2];
            }
            if (test.c[3] == SMOOTH) {
                const auto& m = planes.data[base + tile.ids.c[k]].to_texel.data;
                auto alpha_at = [&](int at_column, int at_row) -> float {
                    const float x = (float)at_column, y = (float)at_row, w = m[2][0] * x + (m[2][1] * y + m[2][2]);
                    const float u = (m[0][0] * x + (m[0][1] * y + m[0][2])) / w, v = (m[1][0] * x + (m[1][1] * y + m[1][2])) / w;
                    return w > 0.0f && u > -1.0f && u < (float)width && v > -1.0f && v < (float)height ? beyond(u, v)[3] : 0.0f;
                };
                for (int l = 0; l < LANES; ++l) {
                    const float across = LANES > 1 ? alpha[l ^ 1] : alpha_at(column ^ 1, row);
                    const float down = LANES > 1 ? alpha[l ^ COLUMNS] : alpha_at(column, row ^ 1);
                    const float contrast = fabsf(across - alpha[l]) + fabsf(down - alpha[l]);
                    const float steep = 1.0f / (contrast > LEAST_CONTRAST ? contrast : LEAST_CONTRAST);
                    const float rate = ((rates[l] == 0.0f) | (steep < rates[l])) ? steep : rates[l];
                    rates[l] = rate;
                    gentle[l] = rate < STEEPEST ? rate : STEEPEST;
                }
                for (int l = 0; l < LANES; ++l) {
                    gentle[l] = alpha[l] > 0.0f ? gentle[l] : 0.0f;  // what has no alpha stays invisible
                    rates[l] = alpha[l] > 0.0f ? rates[l] : -1.0f;
                }
            }
            for (int l = 0; l < LANES; ++l) {
                const float above = alpha[l] - test.c[0], ramp = 0.5f + above * rates[l];
                const float clamped = ramp < 0.0f ? 0.0f : ramp > 1.0f ? 1.0f : ramp, step = above >= 0.0f ? 1.0f : 0.0f;
                const float opaque = rates[l] == 0.0f ? step : clamped;
                alpha[l] = rates[l] < 0.0f ? 0.0f : opaque;
                slopes[l] = fabsf(above) * gentle[l] <= 0.5f ? gentle[l] : 0.0f;
            }
        }
    }
"""
_BLEND = """
    const pixel* samples = (const pixel*)tile.samples.data[tile.order.data[position][0] * LANES];
    const float* opacities = tile.opacities.data[tile.order.data[position][0]];
    pixel gathered[LANES];
    float of_gathered[LANES];
    if (!tile.same.c[position]) {
        for (int l = 0; l < LANES; ++l) {
            const int k = tile.order.data[position][l];
            gathered[l] = *(const pixel*)tile.samples.data[k * LANES + l];
            of_gathered[l] = tile.opacities.data[k][l];
        }
        samples = gathered;
        opacities = of_gathered;
    }
    float *exposed = tile.exposed.data[position], *shares = tile.shares.data[position], *through = tile.through.c;
    if (nested) {
        for (int l = 0; l < LANES; ++l) {
            const float rest = opacities[l] + through[l] - 1.0f;
            shares[l] = rest > 0.0f ? rest : 0.0f;
        }
    } else {
        for (int l = 0; l < LANES; ++l) shares[l] = through[l] * opacities[l];
    }
    int open = 0;
    for (int l = 0; l < LANES; ++l) {
        exposed[l] = through[l];
        through[l] -= shares[l];
        open |= through[l] > 0.0f;
    }
    pixel* color = (pixel*)tile.color.data[0];
    for (int l = 0; l < LANES; ++l) color[l] = color[l] + samples[l] * shares[l];
    return open;
"""
_VACANT = """
    for (int k = 0; k < tile.active; ++k) {
        for (int l = 0; l < LANES; ++l) {
            const int i = tile.place.data[k][l], j = i + tile.widths.c[k];
            const unsigned char* f = occupied.data;
            if (i == BORDER || (i >= 0 && (f[i / BLOCK] | f[(i + 1) / BLOCK] | f[j / BLOCK] | f[(j + 1) / BLOCK]))) return false;
        }
    }
    return true;
"""
_COMPARED = """
    for (int c = 0; c < 4; ++c) {
        tile.linear.data[lane][c] = linear.c[c];
        tile.slope.data[lane][c] = slope.c[c];
        tile.seen.data[lane][c] = seen.c[c];
    }
"""
_PULL_BACK = """
    const pixel* g = (const pixel*)tile.slope.data[0];
    float values[CAPACITY][LANES], behind[LANES] = {};  // v_k and s_k of kernels.py
    for (int p = tile.active - 1; p >= 0; --p) {
        float parts[LANES];
        for (int l = 0; l < LANES; ++l) {
            const int k = tile.order.data[p][l];
            const pixel products = *(const pixel*)tile.samples.data[k * LANES + l] * g[l];
            values[p][l] = (products[0] + products[1]) + (products[2] + products[3]);
            parts[l] = tile.opacities.data[k][l];
        }
        if (nested) {
            for (int l = 0; l < LANES; ++l) parts[l] = tile.shares.data[p][l] > 0.0f ? 1.0f : 0.0f;
        }
        for (int l = 0; l < LANES; ++l) {
            values[p][l] -= behind[l];
            behind[l] += parts[l] * values[p][l];
        }
    }
    for (int p = 0; p < tile.active; ++p) {
        const float *shares = tile.shares.data[p], *exposed = tile.exposed.data[p];
        for (int l = 0; l < LANES; ++l) {
            const float in_front = nested ? (shares[l] > 0.0f ? 1.0f : 0.0f) : exposed[l];
            values[p][l] *= in_front;
        }
        for (int l = 0; l < LANES; ++l) {
            const int k = tile.order.data[p][l];
            pixel* s = (pixel*)tile.samples.data[k * LANES + l];
            pixel of_color = g[l];
            if (own_colors) {
                const pixel seen = *(const pixel*)tile.seen.data[l];
                of_color = *(const pixel*)tile.linear.data[l] + (*s * seen[3] - seen) * (2.0f * weight);
            }
            pixel of_sample = of_color * shares[l];
            of_sample[3] = values[p][l] * tile.slopes.data[k][l];
            *s = of_sample;
        }
    }
"""
_SCATTER = """
    for (int k = 0; k < tile.active; ++k) {
        const int first = tile.firsts.c[k], height = tile.heights.c[k], width = tile.widths.c[k], id = tile.ids.c[k];
        const auto& m = planes.data[base + id].to_texel.data;
        float of_u[LANES], of_v[LANES];
        for (int l = 0; l < LANES; ++l) {
            const pixel g = *(const pixel*)tile.samples.data[k * LANES + l];
            const int i = tile.place.data[k][l], j = i + width;
            float fx = tile.fx.data[k][l], fy = tile.fy.data[k][l];
            of_u[l] = of_v[l] = 0.0f;
            if (i == MISS || (g[3] == 0.0f && g[0] == 0.0f && g[1] == 0.0f && g[2] == 0.0f)) continue;
            if (i >= 0) {
                const pixel right = g * fx, left = g - right, lower_right = right * fy, lower_left = left * fy;
                add(i, left - lower_left);
                add(i + 1, right - lower_right);
                add(j, lower_left);
                add(j + 1, lower_right);
                if (moving) {
                    const pixel *p = (const pixel*)(texels.data + i), *q = (const pixel*)(texels.data + j);
                    const pixel by_u = ((p[1] - p[0]) * (1.0f - fy) + (q[1] - q[0]) * fy) * g;
                    const pixel by_v = ((q[0] - p[0]) * (1.0f - fx) + (q[1] - p[1]) * fx) * g;
                    of_u[l] = (by_u[0] + by_u[1]) + (by_u[2] + by_u[3]);
                    of_v[l] = (by_v[0] + by_v[1]) + (by_v[2] + by_v[3]);
                }
            } else {
                const corners near = around(fx, fy, first, height, width);
                float gains[4];
                for (int c = 0; c < 4; ++c) {
                    pixel part = g;
                    if (!near.there[c]) part[3] = 0.0f;
                    add(near.at[c], part * near.weights[c]);
                    const pixel gain = *(const pixel*)(texels.data + near.at[c]) * part;
                    gains[c] = (gain[0] + gain[1]) + (gain[2] + gain[3]);
                }
                fx -= floorf(fx);
                fy -= floorf(fy);
                of_u[l] = (gains[1] - gains[0]) * (1.0f - fy) + (gains[3] - gains[2]) * fy;
                of_v[l] = (gains[2] - gains[0]) * (1.0f - fx) + (gains[3] - gains[1]) * fx;
            }
        }
        if (!moving) continue;
        float sums[3][3] = {};  // of the derivatives by u / w, v / w and 1 / w, times the pixel's place in the tile
        for (int l = 0; l < LANES; ++l) {
            const float right = (float)(l % COLUMNS), down = (float)(l / COLUMNS), x = (float)column + right, y = (float)row + down;
            const float scale = ((of_u[l] == 0.0f) & (of_v[l] == 0.0f)) ? 0.0f : 1.0f / (m[2][0] * x + (m[2][1] * y + m[2][2]));
            const float u = (m[0][0] * x + (m[0][1] * y + m[0][2])) * scale, v = (m[1][0] * x + (m[1][1] * y + m[1][2])) * scale;
            const float by_u = of_u[l] * scale, by_v = of_v[l] * scale, by_w = -(u * by_u + v * by_v);
            sums[0][0] += by_u * right;
            sums[0][1] += by_u * down;
            sums[0][2] += by_u;
            sums[1][0] += by_v * right;
            sums[1][1] += by_v * down;
            sums[1][2] += by_v;
            sums[2][0] += by_w * right;
            sums[2][1] += by_w * down;
            sums[2][2] += by_w;
        }
        const double place[3] = {double(column), double(row), 0.0};
        double* matrix = (double*)matrices.data + 9 * ((long long)line * count + id);
        for (int e = 0; e < 9; ++e) wp::atomic_add(matrix + e, double(sums[e / 3][e % 3]) + place[e % 3] * double(sums[e / 3][2]));
    }
"""


@cache
def tiles(capacity: int, lanes: int) -> SimpleNamespace:
    """The structure ``Tile`` for at most ``capacity`` layers of ``lanes`` pixels, 1 or an even number in two rows, and its functions.

    A tile's place is that of its first pixel, (``column``, ``row``), and ``base`` the first plane of its view. An alpha mode ``test`` is the
    cutoff or :data:`BLENDED` or :data:`HASHED`; the hardness (0: a step), or the samples of a pixel (0: any number); the slope of the
    gradient; and 0, :data:`SMOOTH` or :data:`COVERAGE`.
    """
    columns = max(lanes // 2, 1)
    wide = wp.types.vector(length=lanes, dtype=wp.float32)
    each = wp.types.vector(length=capacity, dtype=wp.int32)
    wides = wp.types.matrix(shape=(capacity, lanes), dtype=wp.float32)
    wides_ints = wp.types.matrix(shape=(capacity, lanes), dtype=wp.int32)
    colors = wp.types.matrix(shape=(lanes, 4), dtype=wp.float32)
    layered = wp.types.matrix(shape=(capacity * lanes, 4), dtype=wp.float32)
    prefix = f"constexpr int CAPACITY = {capacity}, LANES = {lanes}, COLUMNS = {columns};" + _CONSTANTS

    @wp.struct
    class Tile:
        count: int  # of planes
        listed: each  # planes in the order of the last tile
        active: int  # number of layers: planes that some pixel meets
        slots: each  # of each layer: its place in ``listed``
        ids: each  # its plane
        firsts: each  # its texture
        heights: each
        widths: each
        sampled: each
        same: each  # of each position: whether all pixels have the same layer there
        place: wides_ints  # of each layer and pixel: the upper left texel, MISS or BORDER
        fx: wides  # texel coordinates, less their whole parts unless ``place`` is BORDER
        fy: wides
        samples: layered  # straight color and 1; in the end the derivative in the sample
        opacities: wides
        slopes: wides  # of opacity
        order: wides_ints  # of each position, front to back, and pixel: the layer
        near: wides
        exposed: wides  # transmittance in front
        shares: wides  # weight in the picture
        through: wide  # of each pixel: transmittance so far
        color: colors  # the picture so far
        linear: colors  # derivative that was given
        slope: colors  # derivative in the picture, with that of the pixel loss
        seen: colors  # the view

    @wp.func_native(prefix + _RESTART)
    def restart(tile: wp.ref[Tile], count: int):
        """Begin a row of tiles that meet ``count`` planes."""

    @wp.func_native(prefix + _MEET)
    def meet(
        tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, column: int, row: int, orthographic: int,
        texels: wp.array(dtype=wp.vec4), gradient: wp.array(dtype=wp.vec4),
    ):  # fmt: skip
        """Compute texel coordinates of all pixels on all planes; layers are in the order of the last tile."""

    @wp.func_native(prefix + _ARRANGE)
    def arrange(tile: wp.ref[Tile]):
        """Sort the layers of each pixel, front to back."""

    @wp.func_native(prefix + PIXEL + _CORNERS + _SAMPLE)
    def sample(
        tile: wp.ref[Tile], position: int, shown: int, test: wp.vec4, planes: wp.array(dtype=Plane), base: int, column: int, row: int,
        texels: wp.array(dtype=wp.vec4), occupied: wp.array(dtype=wp.uint8),
    ):  # fmt: skip
        """Filter the textures of the layers at a position, unless done before; with ``shown`` only of those that something shows of."""

    @wp.func_native(prefix + PIXEL + _BLEND)
    def blend(tile: wp.ref[Tile], position: int, nested: int) -> bool:
        """Composite the layers at a position. Returns whether anything behind them can show."""

    @wp.func_native(prefix + _VACANT)
    def vacant(tile: wp.ref[Tile], occupied: wp.array(dtype=wp.uint8)) -> bool:
        """Whether all blocks of texels that the tile reads are transparent."""

    @wp.func_native("const float* c = tile.color.data[lane]; return wp::vec_t<4, wp::float32>(c[0], c[1], c[2], c[3]);")
    def color_of(tile: wp.ref[Tile], lane: int) -> wp.vec4:
        """The picture in a pixel."""

    @wp.func_native(prefix + _COMPARED)
    def compared(tile: wp.ref[Tile], lane: int, linear: wp.vec4, slope: wp.vec4, seen: wp.vec4):
        """Set the derivatives in a pixel and what the view has there."""

    @wp.func_native(prefix + PIXEL + _PULL_BACK)
    def pull_back(tile: wp.ref[Tile], nested: int, own_colors: int, weight: float):
        """Replace samples by the derivatives in them."""

    @wp.func_native(prefix + PIXEL + _ADD + _CORNERS + _SCATTER)
    def scatter(
        tile: wp.ref[Tile], planes: wp.array(dtype=Plane), base: int, column: int, row: int, texels: wp.array(dtype=wp.vec4),
        gradient: wp.array(dtype=wp.vec4), moving: bool, matrices: wp.array(dtype=wp.mat33d), line: int, count: int,
    ):  # fmt: skip
        """Add the derivatives in the samples to ``gradient`` and, if the planes are ``moving``, to ``matrices`` [lines, ``count``]."""

    return SimpleNamespace(**{name: value for name, value in locals().items() if not name.startswith("_")})
