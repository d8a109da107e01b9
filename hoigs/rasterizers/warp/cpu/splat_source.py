"""C++ of the native CPU kernels: where a splat touches a tile, and its alpha there.

Splats are taken from the tile's list in batches of LANES. First comes the geometry of the whole
batch, one splat a lane: the range of blocks that its ellipse touches in each strip. Then, splat by
splat, alpha in these blocks from the top down, in one of two ways:

- *steady*: log2 alpha is quadratic along a column, so alpha, its growth from block to block and
  the growth's constant ratio need two exponentials a strip and two products a block. The error
  grows with the square of the blocks, so it starts afresh after 32: alpha is then off by some 1e-5
  of itself at the far end of a column, where it is near min_alpha, and by 1e-7 at the near end.
- else an exponential a block. Needed where somewhere in the blocks log2 alpha is beyond the range
  of float32 (needles, and splats much smaller than a pixel): products could not come back from 0.
"""

# The exponent's least value, for the steady way; growth may then reach 2^(110 + 8)
LIMITS = r"""
    constexpr float LEAST = -110.0f;
    constexpr int STEADY = 32;  // blocks before the steady way starts afresh
    float drop[HIGH * BLOCKS + LANES] __attribute__((aligned(64)));  // the part of y, by row
    float slide[BLOCKS + LANES] __attribute__((aligned(64)));  // the shift of u, by block
"""

GEOMETRY = r"""
    vec field[16];  // of a record, one splat a lane
    for (int i = 0; i < LANES; ++i) {
        const int k = batch + (i < size ? i : 0);
        const int ahead = k + LANES < end ? k + LANES : k;
        const float* g = records_ + 16ll * indices_[2 * k];
        for (int j = 0; j < 6; ++j) lane_of(field[j], i) = g[j];
        for (int j = 10; j < 16; ++j) lane_of(field[j], i) = g[j];
        __builtin_prefetch(records_ + 16ll * indices_[2 * ahead]);
        $PREFETCH
    }
    vec cxs = field[0] - (float)X, cys = field[1] - (float)Y;
    vec sharps = root(field[2]), leans = sharps * field[3];
    const vec peak = field[3] * field[11];  // dx of the ellipse's lowest point
    vec bends = -2.0f * HIGH * HIGH * (leans * leans + field[4]);
    ivec firsts[2], lasts[2], wild = bends < LEAST;
    for (int s = 0; s < 2; ++s) {
        const vec start = (float)(8 * s) + 0.5f - cxs, stop = start + 7.0f;
        const vec left = greater(start, -field[10]), right = lesser(stop, field[10]);
        const vec x0 = lesser(greater(-peak, left), right), sine0 = x0 * field[15];
        const vec x1 = lesser(greater(peak, left), right), sine1 = x1 * field[15];
        const vec half0 = root(greater(1.0f - sine0 * sine0, same(0.0f)));
        const vec half1 = root(greater(1.0f - sine1 * sine1, same(0.0f)));
        const vec y0 = field[12] * x0 - field[13] * half0 + cys - (HIGH - 0.5f);
        const vec y1 = field[12] * x1 + field[13] * half1 + cys - 0.5f;
        const vec upper = same((float)top[s]), lower = same((float)(bottom[s] - 1));
        const vec first = __builtin_elementwise_ceil(greater(y0 / HIGH, upper));
        const vec last = __builtin_elementwise_floor(lesser(y1 / HIGH, lower));
        const ivec touched = (left <= right) & (first <= last);
        // the exponent is least in a corner
        for (int j = 0; j < 4; ++j) {
            const vec dy = (j & 1 ? first : last + 1.0f) * HIGH + (j & 1 ? 0.5f : -0.5f)
                - cys;
            const vec u = sharps * (j & 2 ? start : stop) - leans * dy;
            wild |= touched & (field[5] - field[4] * dy * dy - u * u < LEAST);
        }
        firsts[s] = __builtin_convertvector(only(first, touched), ivec);
        lasts[s] = __builtin_convertvector(touched ? last : same(-1.0f), ivec);
    }
    vec ratios = power_of_2(greater(bends, same(LEAST)));
"""

# Each splat of a tile's list, nearest first; `continue` leaves it.
SPLATS = r"""
    int top[2] = {0, 0}, bottom[2] = {deep, deep};  // blocks that have not stopped
    for (int batch = begin; batch < end; batch += LANES) {
        for (int s = 0; s < 2; ++s) {
            const Block* p = blocks + s * BLOCKS;
            while (top[s] < bottom[s] && !any(p[top[s]].T > 0.0f)) ++top[s];
            while (bottom[s] > top[s] && !any(p[bottom[s] - 1].T > 0.0f)) --bottom[s];
        }
        if (top[0] >= bottom[0] && top[1] >= bottom[1]) break;
        const int size = end - batch < LANES ? end - batch : LANES;
        $GEOMETRY
        for (int n = 0; n < size; ++n) {
            const int first[2] = {((int*)&firsts[0])[n], ((int*)&firsts[1])[n]};
            const int last[2] = {((int*)&lasts[0])[n], ((int*)&lasts[1])[n]};
            if (first[0] > last[0] && first[1] > last[1]) continue;
            const long long id = indices_[2 * (batch + n)];
            const float* g = records_ + 16 * id;
            const float* f = features_ + id * channels + pass;
            const float cx = lane_of(cxs, n), cy = lane_of(cys, n);
            const float shear = g[3], c = g[4], log2_opacity = g[5];
            const float sharp = lane_of(sharps, n), lean = lane_of(leans, n);
            $BEFORE
            for (int s = 0; s < 2; ++s) {
                $STRIP
                if (first[s] <= last[s]) {
                    $ALPHA
                }
                $STRIP_END
            }
            $AFTER
        }
    }
"""

# log2 alpha = log2_opacity - c dy^2 - u^2 with u = sharp dx - lean dy
ALPHA = r"""
    const vec dx = lane_x + ((float)(8 * s) - cx);
    if (((int*)&wild)[n] == 0) {
        const float jump = HIGH * lean, ratio = lane_of(ratios, n);
        for (int from = first[s]; from <= last[s]; from += STEADY) {
            const vec dy = lane_y + ((float)(HIGH * from) + 0.5f - cy);
            const vec u = sharp * dx - lean * dy;
            vec now = power_of_2(log2_opacity - c * dy * dy - u * u);
            vec growth = power_of_2(2.0f * jump * u - 2.0f * HIGH * c * dy
                - (jump * jump + HIGH * HIGH * c));
            const int upto = last[s] < from + STEADY ? last[s] + 1 : from + STEADY;
            for (int b = from; b < upto; ++b) {
                const vec opaque = only(lesser(now, ceiling), now >= min_alpha);
                now *= growth;
                growth *= ratio;
                $BLOCK
            }
        }
    } else {
        for (int v = first[s] / LANES * LANES; v <= last[s]; v += LANES)
            *(vec*)(slide + v) = lean
                * ((counting + (float)v) * HIGH + (0.5f - cy));
        const int stop = HIGH * (last[s] + 1);
        for (int v = HIGH * first[s] / LANES * LANES; v < stop; v += LANES) {
            const vec dy = counting + ((float)v + 0.5f - cy);
            *(vec*)(drop + v) = log2_opacity - c * dy * dy;
        }
        const vec u0 = sharp * dx - lean * lane_y;
        for (int b = first[s]; b <= last[s]; ++b) {
            const vec u = u0 - slide[b], x = by_row(drop + HIGH * b) - u * u;
            const vec opaque = only(
                lesser(power_of_2(x), ceiling), x >= log2_min_alpha);
            $BLOCK
        }
    }
"""

# What one block gets from a splat; a pixel that is hit but not drawn stops.
BLOCK = r"""
    Block& p = blocks[s * BLOCKS + b];
    const vec before = p.T;
    vec weight = before * opaque;
    const vec next = before - weight;
    const ivec drawn = next > min_transmittance;
    weight = only(weight, drawn);
    weights[s * BLOCKS + b] = weight;
    $COMPOSITE
    p.T = drawn ? next : (vec)((ivec)before | SIGN);
"""
