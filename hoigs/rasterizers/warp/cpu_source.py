"""C++ of the fast CPU tile loops, compiled by Warp's own Clang: no compiler on the user's machine.

LLVM does not vectorise a compositing loop by itself, so these spell out vectors of 16 floats with
Clang's vector extension, which becomes AVX-512, AVX2, SSE or NEON as the machine has it.

A tile is one vector (16 pixels) wide and `rows` (at most MAX_ROWS) high; lane i of vector r is
pixel (X + i, Y + r). Its transmittance T is kept negative once a pixel has stopped, and from the
start for lanes beyond the right edge. Names of arguments stand in `cpu_kernels`. `float(x)` and
`int(x)` are macros of Warp here: casts are written (float)(x).
"""

MAX_ROWS = 64
UNROLL = 2  # rows in flight at once: one alone leaves the core waiting for its own results
EXTRA = 16  # feature channels composited in one pass; more take further passes

_TYPES = r"""
    typedef float f16 __attribute__((vector_size(64)));
    typedef int i16 __attribute__((vector_size(64)));
    typedef float f8 __attribute__((vector_size(32)));
    typedef float f4 __attribute__((vector_size(16)));
    constexpr int ROWS = %(ROWS)d, EXTRA = %(EXTRA)d, U = %(UNROLL)d, AHEAD = 4;
    const i16 SIGN = (i16){} | (int)0x80000000;
    auto same = [](float x) -> f16 { return (f16){} + x; };
    auto any = [](i16 mask) -> bool { return __builtin_reduce_or(mask) != 0; };
    auto least = [](float a, float b) { return a < b ? a : b; };
    auto most = [](float a, float b) { return a > b ? a : b; };
    auto root = [](float x) { return __builtin_sqrtf(x > 0.0f ? x : 0.0f); };
    // read through `volatile`, constants stay in registers; LLVM would fetch each anew in every row
    // (polynomial for 2^x on [-0.5, 0.5], minimax with 1 at 0: relative error 1e-7)
    volatile float constants[] = {1.326469559e-3f, 9.671502106e-3f, 5.550733723e-2f,
        2.402224225e-1f, 6.931469777e-1f, 12582912.0f};
    const f16 e5 = same(constants[0]), e4 = same(constants[1]), e3 = same(constants[2]);
    const f16 e2 = same(constants[3]), e1 = same(constants[4]), magic = same(constants[5]);
    const f16 ceiling = same(max_alpha);
    f16 lane;
    for (int i = 0; i < 16; ++i) lane[i] = (float)i + 0.5f;
    const float* records_ = (const float*)records.data;
    const float* features_ = (const float*)features.data;
    const float* background_ = (const float*)background.data;
    const int* pairs_ = (const int*)pairs.data;
    const int* offsets_ = (const int*)offsets.data;
    float* color_ = (float*)color.data;
    float* alpha_ = (float*)alpha.data;
    float* depth_ = (float*)depth.data;
    float* extra_ = (float*)extra.data;
    #define EACH for (int j = 0; j < U; ++j)
    f16 T[ROWS], red[ROWS], green[ROWS], blue[ROWS], dist[ROWS];
    f16 more[ROWS * EXTRA];
"""
_TILES = r"""
    for (;;) {
        const int tile = __atomic_fetch_add((int*)counters.data + counter, 1, __ATOMIC_RELAXED);
        if (tile >= tiles) break;
        const int X = tile % across * 16, Y = tile / across * rows;
        const int high = height - Y < rows ? height - Y : rows;
        const int wide = width - X < 16 ? width - X : 16;
        const int begin = offsets_[tile], end = offsets_[tile + 1];
        for (int pass = 0; pass == 0 || pass < channels; pass += EXTRA) {
            const int extras = channels - pass < EXTRA ? channels - pass : EXTRA;
"""

# For one pair: the rows that the splat's ellipse touches in this tile, then, a row at a time,
# alpha, which pixels it hits, and the weights. `continue` leaves the pair.
_PAIR = r"""
            int top = 0, bottom = high;
            for (int k = begin; k < end; ++k) {
                if (((k - begin) & 15) == 15) {  // rows that have stopped are left out
                    while (top < bottom && !any(T[top] > 0.0f)) ++top;
                    while (bottom > top && !any(T[bottom - 1] > 0.0f)) --bottom;
                    if (top >= bottom) break;
                }
                const long long id = pairs_[2 * k];
                const float* g = records_ + 16 * id;
                const int* ahead = pairs_ + 2 * (k + AHEAD < end ? k + AHEAD : k);
                __builtin_prefetch(records_ + 16ll * ahead[0]);
                %(AHEAD)s
                const float cx = g[0] - (float)X, cy = g[1] - (float)Y;
                const float a = g[2], shear = g[3], c = g[4], log2_opacity = g[5];
                const float half_width = g[10];
                const float left = most(0.5f - cx, -half_width);
                const float right = least(15.5f - cx, half_width);
                const float peak = shear * g[11];  // dx of the ellipse's lowest point
                const float x1 = least(most(peak, left), right);
                const float x0 = least(most(-peak, left), right);
                const float s1 = x1 * g[15], s0 = x0 * g[15];
                const float y1 = g[12] * x1 + g[13] * root(1.0f - s1 * s1) + cy - 0.5f;
                const float y0 = g[12] * x0 - g[13] * root(1.0f - s0 * s0) + cy - 0.5f;
                const int first = y0 > (float)top ? (int)__builtin_ceilf(y0) : top;
                const int last = y1 < (float)(bottom - 1) ? (int)__builtin_floorf(y1) : bottom - 1;
                if (first > last) continue;
                const f16 dx = lane - cx;
                const float* f = features_ + id * channels + pass;
                %(BEFORE)s
                for (int r = first; r <= last; r += U) {
                    float dy[U];
                    f16 exponent[U], near[U], power[U], raw[U], opaque[U], next[U], weight[U];
                    i16 hit[U], drawn[U];
                    bool some = false;
                    EACH dy[j] = (float)(r + j) + 0.5f - cy;
                    EACH near[j] = dx - shear * dy[j];
                    EACH exponent[j] = (log2_opacity - c * dy[j] * dy[j]) - a * near[j] * near[j];
                    EACH hit[j] = exponent[j] >= log2_min_alpha;
                    EACH some |= any(hit[j]);
                    if (!some) continue;
                    // 2^x, x in [-126, 0]; adding the magic number leaves round(x) in the low bits
                    EACH near[j] = exponent[j] + magic;
                    EACH exponent[j] -= near[j] - magic;
                    EACH power[j] = exponent[j] * e5 + e4;
                    EACH power[j] = power[j] * exponent[j] + e3;
                    EACH power[j] = power[j] * exponent[j] + e2;
                    EACH power[j] = power[j] * exponent[j] + e1;
                    EACH power[j] = power[j] * exponent[j] + 1.0f;
                    EACH raw[j] = (f16)((i16)power[j] + ((i16)near[j] << 23));
                    EACH opaque[j] = raw[j] < ceiling ? raw[j] : ceiling;
                    EACH weight[j] = T[r + j] * opaque[j];
                    EACH next[j] = T[r + j] - weight[j];
                    EACH drawn[j] = hit[j] & (next[j] > min_transmittance);
                    EACH weight[j] = (f16)((i16)weight[j] & drawn[j]);
                    %(ROW)s
                    // a pixel that is hit but not drawn has stopped
                    EACH T[r + j] = (f16)(((i16)next[j] & drawn[j])
                        | (((i16)T[r + j] | (hit[j] & SIGN)) & ~drawn[j]));
                }
                %(AFTER)s
            }
"""

_FORWARD = r"""
            for (int r = 0; r < high; ++r) {
                T[r] = same(1.0f);
                red[r] = green[r] = blue[r] = dist[r] = same(0.0f);
                for (int i = wide; i < 16; ++i) T[r][i] = -1.0f;
            }
            for (int j = 0; j < extras; ++j)
                for (int r = 0; r < high; ++r) more[j * ROWS + r] = same(0.0f);
            for (int r = high; r < high + U; ++r) T[r] = same(-1.0f);
            %(PAIR)s
            for (int r = 0; r < high; ++r) {
                const long long o = (long long)(Y + r) * width + X;
                for (int i = 0; i < wide; ++i) {
                    float* e = extra_ + (o + i) * channels + pass;
                    for (int j = 0; j < extras; ++j) e[j] = more[j * ROWS + r][i];
                }
                if (pass != 0) continue;
                for (int i = 0; i < wide; ++i) {
                    const float left_ = __builtin_fabsf(T[r][i]);
                    const float* b = background_ + (o + i) * background_stride;
                    float* c = color_ + 3 * (o + i);
                    c[0] = red[r][i] + left_ * b[0];
                    c[1] = green[r][i] + left_ * b[1];
                    c[2] = blue[r][i] + left_ * b[2];
                    alpha_[o + i] = 1.0f - left_;
                    depth_[o + i] = dist[r][i];
                }
            }
        }
    }
"""

# S is what the splats not yet passed still add to the loss's gradient, a scalar a pixel:
# sum over them of w (colour . v_colour + ...). It starts from the finished image.
_BACKWARD = r"""
            // rows below the image, reached by the last step of U rows: never drawn
            for (int r = high; r < high + U; ++r) {
                T[r] = same(-1.0f);
                S[r] = red[r] = green[r] = blue[r] = dist[r] = veil[r] = same(0.0f);
                for (int j = 0; j < extras; ++j) more[j * ROWS + r] = same(0.0f);
            }
            for (int r = 0; r < high; ++r) {
                const long long o = (long long)(Y + r) * width + X;
                T[r] = same(1.0f);
                S[r] = red[r] = green[r] = blue[r] = dist[r] = veil[r] = same(0.0f);
                for (int i = wide; i < 16; ++i) T[r][i] = -1.0f;
                for (int j = 0; j < extras; ++j) more[j * ROWS + r] = same(0.0f);
                for (int i = 0; i < wide; ++i) {
                    float s = 0.0f;
                    for (int j = 0; j < extras; ++j) {
                        const long long e = (o + i) * channels + pass + j;
                        more[j * ROWS + r][i] = v_extra_[e];
                        s += extra_[e] * v_extra_[e];
                    }
                    if (pass == 0) {
                        const float* b = background_ + (o + i) * background_stride;
                        const float* c = color_ + 3 * (o + i);
                        const float* v = v_color_ + 3 * (o + i);
                        red[r][i] = v[0];
                        green[r][i] = v[1];
                        blue[r][i] = v[2];
                        dist[r][i] = v_depth_[o + i];
                        veil[r][i] = v_alpha_[o + i] - (b[0] * v[0] + b[1] * v[1] + b[2] * v[2]);
                        s += (c[0] - b[0]) * v[0] + (c[1] - b[1]) * v[1] + (c[2] - b[2]) * v[2];
                        s += depth_[o + i] * v_depth_[o + i] + alpha_[o + i] * v_alpha_[o + i];
                    }
                    S[r][i] = s;
                }
            }
            %(PAIR)s
        }
    }
"""

_BACKWARD_HEAD = r"""
    const float* v_color_ = (const float*)v_color.data;
    const float* v_alpha_ = (const float*)v_alpha.data;
    const float* v_depth_ = (const float*)v_depth.data;
    const float* v_extra_ = (const float*)v_extra.data;
    float* partials_ = (float*)partials.data;
    const int stride = 10 + channels;
    f16 S[ROWS], veil[ROWS], sums[EXTRA];
    const f16 tiny = same(1e-7f);
    auto reciprocal = [](f16 x) -> f16 {
#if defined(__AVX512F__)
        // 14 bits and one Newton step, relative error 1e-7: a division holds the core up
        const f16 r = __builtin_ia32_rcp14ps512_mask(x, x, (unsigned short)-1);
        return r * (2.0f - x * r);
#else
        return 1.0f / x;
#endif
    };
    auto total = [](f16 x) -> float {
        const f8 h = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7)
            + __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
        const f4 q = __builtin_shufflevector(h, h, 0, 1, 2, 3)
            + __builtin_shufflevector(h, h, 4, 5, 6, 7);
        return (q[0] + q[2]) + (q[1] + q[3]);
    };
"""

# Moments about the middle row of the splat in this tile and along the slanted line there: the
# shift from them to u and dy is then at most a tile's width, so little cancels.
_BACKWARD_BEFORE = r"""
                f16 g0 = same(0.0f), g1 = g0, g2 = g0, r0 = g0, r1 = g0, r2 = g0, r3 = g0;
                for (int j = 0; j < extras; ++j) sums[j] = g0;
                const float middle = 0.5f * (float)(first + last + 1) - cy;
"""
_BACKWARD_ROW = r"""
                    f16 value[U], slope[U];
                    EACH value[j] = g[6] * red[r + j] + veil[r + j];
                    EACH value[j] += g[7] * green[r + j];
                    EACH value[j] += g[8] * blue[r + j];
                    EACH value[j] += g[9] * dist[r + j];
                    EACH r0 += weight[j] * red[r + j];
                    EACH r1 += weight[j] * green[r + j];
                    EACH r2 += weight[j] * blue[r + j];
                    EACH r3 += weight[j] * dist[r + j];
                    for (int i = 0; i < extras; ++i) {
                        EACH value[j] += f[i] * more[i * ROWS + r + j];
                        EACH sums[i] += weight[j] * more[i * ROWS + r + j];
                    }
                    EACH S[r + j] -= weight[j] * value[j];
                    EACH slope[j] = 1.0f - opaque[j];
                    EACH slope[j] = reciprocal(slope[j] < tiny ? tiny : slope[j]);
                    EACH slope[j] = opaque[j] * (T[r + j] * value[j] - S[r + j] * slope[j]);
                    EACH slope[j] = (f16)((i16)slope[j] & (drawn[j] & (raw[j] <= ceiling)));
                    EACH g0 += slope[j];
                    EACH g1 += slope[j] * (dy[j] - middle);
                    EACH g2 += slope[j] * ((dy[j] - middle) * (dy[j] - middle));
"""
_BACKWARD_AFTER = r"""
                float* o = partials_ + (long long)pairs_[2 * k + 1] * stride;
                const f16 um = dx - shear * middle;
                const f16 g0u = g0 * um;
                const float m = total(g0), mt = total(g1), mtt = total(g2);
                const float mu = total(g0u), muu = total(g0u * um), mut = total(g1 * um);
                const float gu = mu - shear * mt;
                o[0] += m;
                o[1] += gu;
                o[2] += mt + middle * m;
                o[3] += muu - 2.0f * shear * mut + shear * shear * mtt;
                o[4] += mut - shear * mtt + middle * gu;
                o[5] += mtt + 2.0f * middle * mt + middle * middle * m;
                if (pass == 0) {
                    o[6] = total(r0);
                    o[7] = total(r1);
                    o[8] = total(r2);
                    o[9] = total(r3);
                }
                for (int j = 0; j < extras; ++j) o[10 + pass + j] = total(sums[j]);
"""
_FORWARD_ROW = r"""
                    EACH red[r + j] += weight[j] * g[6];
                    EACH green[r + j] += weight[j] * g[7];
                    EACH blue[r + j] += weight[j] * g[8];
                    EACH dist[r + j] += weight[j] * g[9];
                    for (int i = 0; i < extras; ++i)
                        EACH more[i * ROWS + r + j] += weight[j] * f[i];
"""

_SIZES = {"ROWS": MAX_ROWS + UNROLL + 1, "EXTRA": EXTRA, "UNROLL": UNROLL}
_FORWARD_PAIR = _PAIR % {"AHEAD": "", "BEFORE": "", "ROW": _FORWARD_ROW, "AFTER": ""}
_BACKWARD_PAIR = _PAIR % {
    "AHEAD": "__builtin_prefetch(partials_ + (long long)ahead[1] * stride, 1);",
    "BEFORE": _BACKWARD_BEFORE,
    "ROW": _BACKWARD_ROW,
    "AFTER": _BACKWARD_AFTER,
}
FORWARD = _TYPES % _SIZES + _TILES + _FORWARD % {"PAIR": _FORWARD_PAIR}
BACKWARD = _TYPES % _SIZES + _BACKWARD_HEAD + _TILES + _BACKWARD % {"PAIR": _BACKWARD_PAIR}

PREFETCH = r"""__builtin_prefetch((const float*)array.data + index);"""

# The number of the next piece of work, for workers that share `counters`.
TAKE = r"""return __atomic_fetch_add((int*)counters.data + counter, 1, __ATOMIC_RELAXED);"""

# Address of a function that drains a queue of compiled kernels; each worker of a pool calls it.
QUEUE = r"""
    struct Job { void (*run)(void*, void*); void* bounds; void* arguments; };
    struct Queue { Job* jobs; int count; int next; };
    auto drain = [](void* data) {
        Queue* queue = (Queue*)data;
        for (;;) {
            const int i = __atomic_fetch_add(&queue->next, 1, __ATOMIC_RELAXED);
            if (i >= queue->count) break;
            queue->jobs[i].run(queue->jobs[i].bounds, queue->jobs[i].arguments);
        }
    };
    void (*entry)(void*) = drain;
    *(unsigned long long*)address.data = (unsigned long long)entry;
"""
