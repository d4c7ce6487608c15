"""C++ of the functions in :mod:`bbfit.operators.drawing.tile_kernels` that differentiate; one source for the CPU and CUDA."""

from __future__ import annotations

# Adding to a texel's gradient, and to a sum. On a CPU no two threads add to the same.
ADD = """
#if defined(__CUDA_ARCH__)
    auto add = [&](int i, pixel by) { wp::atomic_add(gradient.data + i, wp::vec_t<4, wp::float32>(by[0], by[1], by[2], by[3])); };
    auto accumulate = [](double* sum, double by) { wp::atomic_add(sum, by); };
#else
    auto add = [&](int i, pixel by) { ((pixel*)gradient.data)[i] += by; };
    auto accumulate = [](double* sum, double by) { *sum += by; };
#endif
"""
VACANT = """
    for (int k = 0; k < tile.active; ++k) {
        for (int l = 0; l < LANES; ++l) {
            const int i = tile.place.data[k][l], j = i + planes.data[base + tile.ids.c[k]].texture.c[2];
            const unsigned char* f = occupied.data;
            if (i == BORDER || (i >= 0 && (f[i / BLOCK] | f[(i + 1) / BLOCK] | f[j / BLOCK] | f[(j + 1) / BLOCK]))) return false;
        }
    }
    return true;
"""
ANYTHING = """
    const int across = width - column < COLUMNS ? width - column : COLUMNS;
    int bits = 0;
    for (int y = row; y < row + LANES / COLUMNS && y < height; ++y) {
        const long long start = ((long long)view * height + y) * width + column;
        if (target.data) {
            for (int x = 0; x < across; ++x) bits |= target.data[start + x] & 0xff000000;
        }
        if (gradient.data) {
            const int* numbers = (const int*)(gradient.data + start);
            for (int c = 0; c < 4 * across; ++c) bits |= numbers[c] & 0x7fffffff;
        }
    }
    return bits;
"""
COMPARE = """
    const int across = width - column < COLUMNS ? width - column : COLUMNS;
    const pixel none = {0.0f, 0.0f, 0.0f, 0.0f};
    float total = 0.0f;
    for (int r = 0; r < LANES / COLUMNS; ++r) {
        const int y = row + r, shown = y < height ? across : 0;
        const long long start = ((long long)view * height + y) * width + column;
        const pixel* color = (const pixel*)tile.color.data[r * COLUMNS];
        pixel* linear = (pixel*)tile.linear.data[r * COLUMNS];
        pixel* slope = (pixel*)tile.slope.data[r * COLUMNS];
        pixel* seen = (pixel*)tile.seen.data[r * COLUMNS];
        ONE_BY_ONE
        for (int x = 0; x < COLUMNS; ++x) linear[x] = slope[x] = seen[x] = none;
        if (gradient.data) {
            ONE_BY_ONE
            for (int x = 0; x < shown; ++x) linear[x] = slope[x] = ((const pixel*)gradient.data)[start + x];
        }
        if (target.data) {
            ONE_BY_ONE
            for (int x = 0; x < shown; ++x) seen[x] = premultiplied(target.data[start + x], straight);
            ONE_BY_ONE
            for (int x = 0; x < shown; ++x) total += pixel_loss(color[x] - seen[x], loss, weight, slope[x]);
        }
    }
    return total;
"""
PULL_BACK = """
    const pixel *g = (const pixel*)tile.slope.data[0], *seen = (const pixel*)tile.seen.data[0], *linear = (const pixel*)tile.linear.data[0];
    // v_k and s_k of kernels.py. The depths have been used.
    auto& values = tile.near.data;
    float behind[LANES] = {};
    for (int p = tile.depth - 1; p >= 0; --p) {
        float parts[LANES], raw[LANES];
        if (LANES == 1 || tile.same.c[p]) {
            const int k = tile.order.data[p][0];
            const pixel* samples = (const pixel*)tile.samples.data[k * LANES];
            ONE_BY_ONE
            for (int l = 0; l < LANES; ++l) {
                const pixel products = samples[l] * g[l];
                raw[l] = (products[0] + products[1]) + (products[2] + products[3]);
            }
            for (int l = 0; l < LANES; ++l) parts[l] = tile.opacities.data[k][l];
        } else {
            ONE_BY_ONE
            for (int l = 0; l < LANES; ++l) {
                const int k = tile.order.data[p][l];
                const pixel products = *(const pixel*)tile.samples.data[k * LANES + l] * g[l];
                raw[l] = (products[0] + products[1]) + (products[2] + products[3]);
                parts[l] = tile.opacities.data[k][l];
            }
        }
        for (int l = 0; l < LANES; ++l) {
            const float shown = tile.shares.data[p][l] > 0.0f ? 1.0f : 0.0f, value = raw[l] - behind[l];
            values[p][l] = value * (nested ? shown : tile.exposed.data[p][l]);
            behind[l] += (nested ? shown : parts[l]) * value;
        }
    }
    for (int p = 0; p < tile.depth; ++p) {
        const float* shares = tile.shares.data[p];
        ONE_BY_ONE
        for (int l = 0; l < LANES; ++l) {
            const int k = tile.order.data[p][LANES == 1 || tile.same.c[p] ? 0 : l];
            pixel* s = (pixel*)tile.samples.data[k * LANES + l];
            pixel of_color = g[l];
            if (own_colors) of_color = linear[l] + (*s * seen[l][3] - seen[l]) * (2.0f * weight);
            pixel of_sample = of_color * shares[l];
            of_sample[3] = values[p][l] * tile.slopes.data[k][l];
            *s = of_sample;
        }
    }
"""
SCATTER = """
    for (int k = 0; k < tile.active; ++k) {
        const int id = tile.ids.c[k], *texture = planes.data[base + id].texture.c;
        const int first = texture[0], height = texture[1], width = texture[2];
        const auto& m = planes.data[base + id].to_texel.data;
        float of_u[LANES], of_v[LANES];
        ONE_BY_ONE
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
        double* matrix = (double*)matrices.data + 9 * ((long long)strip * count + id);
        for (int e = 0; e < 9; ++e) accumulate(matrix + e, double(sums[e / 3][e % 3]) + place[e % 3] * double(sums[e / 3][2]));
    }
"""
