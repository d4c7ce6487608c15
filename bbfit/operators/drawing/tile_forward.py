"""C++ of the functions in :mod:`bbfit.operators.drawing.tile_kernels` that draw; one source for the CPU and CUDA.

Warp copies an array that is an element of a structure before it reads or changes one of its numbers. C++ copies nothing, and clang turns
loops over the pixels of a tile into vector instructions.
"""

from __future__ import annotations

from bbfit.operators.drawing.compositing import HASH, LEAST_CONTRAST, STEEPEST, TIE

BLOCK = 4
"""Consecutive texels that share one byte of occupancy and that Adam updates together."""
REACH = 26
"""Largest distance of the texels that a row of pixels in a tile reads, for a test of occupancy."""
SPAN = 64
"""Pixels of a row whose tiles look for their planes together."""
SPARSE = 0.75
"""Least share of the layers of a tile that pixels meet, on average, for which all pixels are sorted together."""
HASHED, BLENDED = -1.0, 0.0
"""Cutoffs of alpha modes that have none."""
SMOOTH, COVERAGE = 1.0, 2.0
"""An antialiased mask, and coverage, in the last place of an encoded alpha mode."""

# MISS: a pixel misses a plane. BORDER: some of a sample's four texels lie beyond the texture's border.
CONSTANTS = f"""
    constexpr int MISS = -1, BORDER = -2, BLOCK = {BLOCK}, REACH = {REACH}, SPAN = {SPAN};
    constexpr unsigned HASH[] = {{{", ".join(f"{factor}u" for factor in HASH)}}};
    constexpr float TIE = {TIE!r}f, STEEPEST = {STEEPEST!r}f, SPARSE = {SPARSE!r}f, LEAST_CONTRAST = {LEAST_CONTRAST!r}f;
    constexpr float HASHED = {HASHED!r}f, BLENDED = {BLENDED!r}f, SMOOTH = {SMOOTH!r}f, COVERAGE = {COVERAGE!r}f;
"""
# The four texels around a sample at texel coordinates (u, v) that may lie beyond the border, clamped to it, and their weights.
CORNERS = """
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


RESTART = """
    tile.reaching = 0;
    for (int n = 0; n < count; ++n) {
        const int* box = planes.data[base + n].box.c;
        const bool above = row + LANES / COLUMNS <= box[2], below = row > box[3];
        if (above || below || end <= box[0] || begin > box[1] || box[0] > box[1]) continue;
        tile.listed.c[tile.reaching++] = n;
    }
"""
NARROW = """
    tile.close = LANES > 1 ? 0 : tile.reaching;  // a single pixel has no other planes than its row
    if (LANES == 1) return;
    for (int slot = 0; slot < tile.reaching; ++slot) {
        const int* box = planes.data[base + tile.listed.c[slot]].box.c;
        if (column + SPAN > box[0] && column <= box[1]) tile.span.c[tile.close++] = slot;
    }
"""
MEET = """
    float xs[LANES], ys[LANES];
    for (int l = 0; l < LANES; ++l) {
        xs[l] = (float)(column + l % COLUMNS);
        ys[l] = (float)(row + l / COLUMNS);
    }
    int k = 0;
    for (int c = 0; c < tile.close; ++c) {
        const int slot = LANES > 1 ? tile.span.c[c] : c, id = tile.listed.c[slot];
        if (column + COLUMNS <= planes.data[base + id].box.c[0] || column > planes.data[base + id].box.c[1]) continue;
        const auto plane = planes.data[base + id];
        const auto& m = plane.to_texel.data;
        const int first = plane.texture.c[0], height = plane.texture.c[1], width = plane.texture.c[2];
        const float last_u = (float)width, last_v = (float)height;
        float nears[LANES], us[LANES], vs[LANES];
        int hits[LANES], met = 0;
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
        for (int l = 0; l < LANES; ++l) met |= hits[l] << l;
        if (!met) continue;
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
        tile.ids.c[k] = id;
        if (LANES > 1) {
            tile.slots.c[k] = slot;
            tile.met.c[k] = met;
            tile.sampled.c[k] = 0;
        }
        ++k;
    }
    tile.active = k;
    for (int l = 0; l < LANES; ++l) {
        tile.through.c[l] = 1.0f;
        for (int c = 0; c < 4; ++c) tile.color.data[l][c] = 0.0f;
    }
"""
ARRANGE = """
    // Whether a layer of depth b, behind one of depth f, is to be in front of it. Of layers of equal depth that of the lower plane is.
    auto misplaced = [](float f, float b, bool lower) { return lower ? f < b - TIE * fabsf(b) : !(b < f - TIE * fabsf(f)); };
    tile.depth = tile.active;
#if !defined(__CUDA_ARCH__)
    int meetings = 0;
    for (int k = 0; k < tile.active && LANES > 1; ++k) meetings += __builtin_popcount(tile.met.c[k]);
    if (LANES > 1 && meetings < SPARSE * (float)(tile.active * LANES)) {
        // Sort the layers of each pixel by themselves, and all of them for the next tile. What is left is a layer that no pixel meets.
        auto before = [&](int k, int other, int l) {  // whether layer k is in front of an earlier one
            return misplaced(tile.near.data[other][l], tile.near.data[k][l], tile.ids.c[other] < tile.ids.c[k]);
        };
        int counts[LANES] = {}, next[CAPACITY];
        for (int k = 0; k < tile.active; ++k) {
            for (int left = tile.met.c[k]; left; left &= left - 1) {
                const int l = __builtin_ctz(left);
                int p = counts[l]++;
                for (; p > 0 && before(k, tile.order.data[p - 1][l], l); --p) tile.order.data[p][l] = tile.order.data[p - 1][l];
                tile.order.data[p][l] = k;
            }
            int p = k;
            for (; p > 0 && before(k, next[p - 1], LANES - 1); --p) next[p] = next[p - 1];
            next[p] = k;
        }
        for (int k = 0; k < tile.active; ++k) tile.listed.c[tile.slots.c[k]] = tile.ids.c[next[k]];
        const int none = tile.active;
        tile.ids.c[none] = tile.ids.c[0];
        tile.sampled.c[none] = 0;
        tile.depth = 0;
        for (int l = 0; l < LANES; ++l) {
            tile.place.data[none][l] = MISS;
            tile.depth = counts[l] > tile.depth ? counts[l] : tile.depth;
        }
        for (int p = 0; p < tile.depth; ++p) {
            for (int l = 0; l < LANES; ++l) tile.order.data[p][l] = p < counts[l] ? tile.order.data[p][l] : none;
            tile.same.c[p] = 0;
        }
        return;
    }
#endif
    bool moved = false;
    for (int p = 0; p < tile.active && LANES > 1; ++p) tile.same.c[p] = 1;
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
                const bool swap = misplaced(f, b, tile.ids.c[of_f] < tile.ids.c[of_b]);
                front[l] = swap ? b : f;
                back[l] = swap ? f : b;
                i[l] = swap ? of_b : of_f;
                j[l] = swap ? of_f : of_b;
                changes += swap;
            }
            if (!changes) break;
            moved = true;
            if (LANES == 1) continue;
            if (changes < LANES) {
                tile.same.c[p - 1] = tile.same.c[p] = 0;
            } else {
                const int kept = tile.same.c[p - 1];
                tile.same.c[p - 1] = tile.same.c[p];
                tile.same.c[p] = kept;
            }
        }
    }
    if (moved && LANES > 1) {
        for (int k = 0; k < tile.active; ++k) tile.listed.c[tile.slots.c[k]] = tile.ids.c[tile.order.data[k][LANES - 1]];
    }
"""
SAMPLE = """
    for (int lane = 0; lane < (LANES == 1 || tile.same.c[position] ? 1 : LANES); ++lane) {
        const int k = tile.order.data[position][lane];
        if (LANES > 1) {
            if (tile.sampled.c[k]) continue;
            tile.sampled.c[k] = 1;
        }
        const int* texture = planes.data[base + tile.ids.c[k]].texture.c;
        const int first = texture[0], height = texture[1], width = texture[2];
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
            int least = place[begin], most = place[begin];
            for (int l = begin; l < begin + COLUMNS; ++l) {
                least = place[l] < least ? place[l] : least;
                most = place[l] > most ? place[l] : most;
            }
            const bool inside = least >= 0;
            bool empty = least == MISS && most == MISS;
            if (inside && shown && most - least <= REACH) {
                int any = 0;
                for (int b = least / BLOCK; b <= (most + 1) / BLOCK; ++b) any |= occupied.data[b];
                for (int b = (least + width) / BLOCK; b <= (most + 1 + width) / BLOCK; ++b) any |= occupied.data[b];
                empty = !any;
            }
            if (empty) {
                ONE_BY_ONE
                for (int l = begin; l < begin + COLUMNS; ++l) {
                    samples[l] = pixel{0.0f, 0.0f, 0.0f, 1.0f};
                    alpha[l] = 0.0f;
                }
                continue;
            }
            ONE_BY_ONE
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
                float contrasts[LANES];
                if (LANES == 1) {
                    contrasts[0] = fabsf(alpha_at(column ^ 1, row) - alpha[0]) + fabsf(alpha_at(column, row ^ 1) - alpha[0]);
                }
                for (int l = 0; l < LANES / 2; ++l) contrasts[2 * l] = contrasts[2 * l + 1] = fabsf(alpha[2 * l] - alpha[2 * l + 1]);
                for (int l = 0; l < LANES / 2; ++l) {
                    const float down = fabsf(alpha[l] - alpha[l + COLUMNS]);
                    contrasts[l] += down;
                    contrasts[l + COLUMNS] += down;
                }
                for (int l = 0; l < LANES; ++l) {
                    const float contrast = contrasts[l];
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
                alpha[l] = ((rates[l] < 0.0f) | (place[l] == MISS)) ? 0.0f : opaque;
                slopes[l] = fabsf(above) * gentle[l] <= 0.5f ? gentle[l] : 0.0f;
            }
        }
    }
"""
BLEND = """
    const pixel* samples = (const pixel*)tile.samples.data[tile.order.data[position][0] * LANES];
    const float* opacities = tile.opacities.data[tile.order.data[position][0]];
    pixel gathered[LANES];
    float of_gathered[LANES];
    if (LANES > 1 && !tile.same.c[position]) {
        ONE_BY_ONE
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
    ONE_BY_ONE
    for (int l = 0; l < LANES; ++l) color[l] = color[l] + samples[l] * shares[l];
    return open;
"""
STORE = """
    ONE_BY_ONE
    for (int l = 0; l < LANES; ++l) {
        const int x = column + l % COLUMNS, y = row + l / COLUMNS;
        if (x >= image.shape[2] || y >= image.shape[1]) continue;
        ((pixel*)image.data)[((long long)view * image.shape[1] + y) * image.shape[2] + x] = *(const pixel*)tile.color.data[l];
    }
"""
