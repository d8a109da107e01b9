"""C++ of the native CPU kernels; Warp's own Clang compiles it.

FORWARD and BACKWARD are put together from `vector_source` (how tiles lie in vectors),
`splat_source` (where a splat is, and its alpha) and what each of them does with a block, which
stands here and in `backward_source`.
"""

from __future__ import annotations

from string import Template

from hoigs.rasterizers.warp.cpu import backward_source

# C++ of the native CPU kernels: vectors, the layout of a tile, the loop over tiles.
#
# LLVM does not vectorise a compositing loop by itself, so vectors of LANES floats are written out
# with Clang's extension, which becomes AVX-512 (16 lanes), or AVX2, SSE or NEON (8 lanes).
#
# A tile is two *strips*, 8 pixels wide and `tile_height` (at most MAX_ROWS) high. A strip is a
# column of *blocks*, one vector each, of 8 pixels by HIGH rows: 2 with 16 lanes, 1 with 8. Narrow
# blocks fit splats of some pixels better than rows of 16: a tenth to a quarter fewer of them are
# touched. Lane i of block b in strip s is pixel (X + 8 s + i / HIGH, Y + HIGH b + i % HIGH). Its
# transmittance T is kept negative once the pixel has stopped, and from the start for lanes outside
# the image.
#
# The arguments are described in `native_kernels`. `float(x)` and `int(x)` are macros of Warp here:
# casts are written (float)(x).

MAX_ROWS = 64
PASS_CHANNELS = 16  # feature channels composited in one pass; more take further passes
VECTORS = r"""
#if defined(__AVX512F__)
    constexpr int LANES = 16;
#else
    constexpr int LANES = 8;
#endif
    constexpr int HIGH = LANES / 8, BLOCKS = $MAX_ROWS / HIGH, PASS_CHANNELS = $PASS_CHANNELS;
    typedef float vec __attribute__((vector_size(4 * LANES)));
    typedef int ivec __attribute__((vector_size(4 * LANES)));
    typedef long long lvec __attribute__((vector_size(4 * LANES)));
    typedef float f8 __attribute__((vector_size(32)));
    typedef float f4 __attribute__((vector_size(16)));
    const ivec SIGN = (ivec){} | (int)0x80000000;
    auto same = [](float x) -> vec { return (vec){} + x; };
    auto only = [](vec x, ivec mask) -> vec { return (vec)((ivec)x & mask); };
    auto any = [](ivec mask) -> bool { return __builtin_reduce_or(mask) != 0; };
    auto lesser = [](vec a, vec b) -> vec { return a < b ? a : b; };
    auto greater = [](vec a, vec b) -> vec { return a > b ? a : b; };
    auto root = [](vec x) -> vec { return __builtin_elementwise_sqrt(x); };
    auto lane_of = [](vec& x, int i) -> float& { return ((float*)&x)[i]; };
#if defined(__AVX512F__)
    auto row_of = [](vec x, int h) -> f8 {  // row h of a block
        return h ? __builtin_shufflevector(x, x, 1, 3, 5, 7, 9, 11, 13, 15)
                 : __builtin_shufflevector(x, x, 0, 2, 4, 6, 8, 10, 12, 14);
    };
    // a number for each row of a block, spread over its lanes
    auto by_row = [](const float* x) -> vec { return (vec)((lvec){} + *(const long long*)x); };
#else
    auto row_of = [](vec x, int) -> f8 { return x; };
    auto by_row = [](const float* x) -> vec { return (vec){} + *x; };
#endif
    // read through `volatile`, constants stay in registers; LLVM would fetch each anew in every row
    // (polynomial for 2^x on [-0.5, 0.5], minimax with 1 at 0: relative error 1e-7)
    volatile float constants[] = {1.326469559e-3f, 9.671502106e-3f, 5.550733723e-2f,
        2.402224225e-1f, 6.931469777e-1f, 12582912.0f};
    const vec e5 = same(constants[0]), e4 = same(constants[1]), e3 = same(constants[2]);
    const vec e2 = same(constants[3]), e1 = same(constants[4]), magic = same(constants[5]);
    // 2^x, x in [-126, 127]; adding the magic number leaves round(x) in the low bits
    auto power_of_2 = [&](vec x) -> vec {
        const vec near = x + magic;
        x -= near - magic;
        vec power = x * e5 + e4;
        power = power * x + e3;
        power = power * x + e2;
        power = power * x + e1;
        power = power * x + 1.0f;
        return (vec)((ivec)power + ((ivec)near << 23));
    };
    vec lane_x, lane_y, counting;  // pixel centres from a block's left side and first row; 0, 1, ..
    for (int i = 0; i < LANES; ++i) {
        lane_x[i] = (float)(i / HIGH) + 0.5f;
        lane_y[i] = (float)(i % HIGH);
        counting[i] = (float)i;
    }
"""
ARGUMENTS = r"""
    const float* records_ = (const float*)records.data;
    const float* features_ = (const float*)features.data;
    const float* background_ = (const float*)background.data;
    const int* indices_ = (const int*)indices.data;
    const int* offsets_ = (const int*)offsets.data;
    float* color_ = (float*)color.data;
    float* alpha_ = (float*)alpha.data;
    float* depth_ = (float*)depth.data;
    float* feature_image_ = (float*)feature_image.data;
    // 1 - alpha is divided by, hence the second bound
    const vec ceiling = same(max_alpha < 0.9999999f ? max_alpha : 0.9999999f);
    const float min_alpha = __builtin_exp2f(log2_min_alpha);
"""

# Each worker takes tile after tile. $BODY runs for every PASS_CHANNELS feature channels, at least
# once; what is not a feature is done in the first pass.
TILES = r"""
    Block blocks[2 * BLOCKS];
    vec feature_blocks[PASS_CHANNELS][2 * BLOCKS];
    vec weights[2 * BLOCKS];  // of the splat in hand
    for (;;) {
        const int tile = __atomic_fetch_add((int*)counters.data + counter, 1, __ATOMIC_RELAXED);
        if (tile >= tiles) break;
        const int X = tile % tiles_x * 16, Y = tile / tiles_x * tile_height;
        const int high = height - Y < tile_height ? height - Y : tile_height;
        const int wide = width - X < 16 ? width - X : 16;
        const int deep = (high + HIGH - 1) / HIGH;  // blocks
        const int begin = offsets_[tile], end = offsets_[tile + 1];
        for (int pass = 0; pass == 0 || pass < channels; pass += PASS_CHANNELS) {
            const int left = channels - pass;
            const int n_features = left < PASS_CHANNELS ? left : PASS_CHANNELS;
            for (int s = 0; s < 2; ++s)
                for (int b = 0; b < deep; ++b) {
                    Block& p = blocks[s * BLOCKS + b] = Block{};
                    p.T = same(1.0f);
                    if (8 * (s + 1) > wide || HIGH * (b + 1) > high)
                        for (int i = 0; i < LANES; ++i)
                            if (8 * s + i / HIGH >= wide || HIGH * b + i % HIGH >= high)
                                lane_of(p.T, i) = -1.0f;
                    for (int j = 0; j < n_features; ++j)
                        feature_blocks[j][s * BLOCKS + b] = same(0.0f);
                }
            $BODY
        }
    }
"""

# The parts of a tile's rows that lie in the image, eight pixels or fewer at a time. In $ROW, o
# is the number of the first of `columns` pixels, which are lanes h, h + HIGH, .. of block `at`.
EACH_ROW = r"""
    for (int s = 0; 8 * s < wide; ++s)
        for (int b = 0; b < deep; ++b) {
            const int at = s * BLOCKS + b, columns = wide - 8 * s < 8 ? wide - 8 * s : 8;
            Block& p = blocks[at];
            $BEFORE
            for (int h = 0; h < HIGH && HIGH * b + h < high; ++h) {
                const long long o = (long long)(Y + HIGH * b + h) * width + X + 8 * s;
                $ROW
            }
            $AFTER
        }
"""


# C++ of the native CPU kernels: where a splat touches a tile, and its alpha there.
#
# Splats are taken from the tile's list in batches of LANES. First comes the geometry of the whole
# batch, one splat a lane: the range of blocks that its ellipse touches in each strip. Then, splat
# by splat, alpha in these blocks from the top down, in one of two ways:
#
# - *steady*: log2 alpha is quadratic along a column, so alpha, its growth from block to block and
#   the growth's constant ratio need two exponentials a strip and two products a block. The error
#   grows with the square of the blocks, so it starts afresh after 32: alpha is then off by some
#     1e-5
#   of itself at the far end of a column, where it is near min_alpha, and by 1e-7 at the near end.
# - else an exponential a block. Needed where somewhere in the blocks log2 alpha is beyond the range
#   of float32 (needles, and splats much smaller than a pixel): products could not come back from 0.


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


def _filled(text: str, **parts: object) -> str:
    """The text with $NAMEs replaced."""
    return Template(text).substitute(parts)


_PIXELS = r"""
    const float* back = background_ + o * background_stride;
    float out[5][8] __attribute__((aligned(32)));
    *(f8*)out[0] = row_of(p.red, h);
    *(f8*)out[1] = row_of(p.green, h);
    *(f8*)out[2] = row_of(p.blue, h);
    *(f8*)out[3] = row_of(left, h);
    *(f8*)out[4] = row_of(p.dist, h);
    float* first = color_ + 3 * o;
    for (int i = 0; i < columns; ++i)
        for (int j = 0; j < 3; ++j)
            first[3 * i + j] = out[j][i]
                + out[3][i] * back[i * background_stride + j];
    for (int i = 0; i < columns; ++i) alpha_[o + i] = 1.0f - out[3][i];
    for (int i = 0; i < columns; ++i) depth_[o + i] = out[4][i];
"""
_FEATURE_PIXELS = r"""
    for (int j = 0; j < n_features; ++j) {
        const f8 row = row_of(feature_blocks[j][at], h);
        for (int i = 0; i < columns; ++i)
            feature_image_[(o + i) * channels + pass + j] = row[i];
    }
    if (pass != 0) continue;
"""
_COMPOSITE = r"""
    p.red += weight * g[6];
    p.green += weight * g[7];
    p.blue += weight * g[8];
    p.dist += weight * g[9];
"""
_FEATURES = r"""
    for (int j = 0; j < n_features; ++j)
        for (int s = 0; s < 2; ++s)
            for (int b = s * BLOCKS + first[s]; b <= s * BLOCKS + last[s]; ++b)
                feature_blocks[j][b] += weights[b] * f[j];
"""
_IMAGE = _filled(
    EACH_ROW,
    BEFORE="const vec left = (vec)((ivec)p.T & ~SIGN);",
    ROW=_FEATURE_PIXELS + _PIXELS,
    AFTER="",
)


def _splats(prefetch: str, composite: str, **parts: str) -> str:
    alpha = _filled(ALPHA, BLOCK=_filled(BLOCK, COMPOSITE=composite))
    geometry = _filled(GEOMETRY, PREFETCH=prefetch)
    return _filled(SPLATS, **parts, GEOMETRY=geometry, ALPHA=alpha)


_SIZES = {"MAX_ROWS": MAX_ROWS, "PASS_CHANNELS": PASS_CHANNELS}


def _kernel(state: str, head: str, body: str) -> str:
    vectors = _filled(VECTORS, **_SIZES)
    start = vectors + ARGUMENTS + LIMITS
    return start + state + head + _filled(TILES, BODY=body)


FORWARD = _kernel(
    "struct Block { vec T, red, green, blue, dist; };",
    "",
    _splats("", _COMPOSITE, BEFORE="", STRIP_END="", STRIP="", AFTER=_FEATURES) + _IMAGE,
)
_GRADIENTS = _kernel(
    backward_source.STATE,
    backward_source.HEAD,
    _filled(
        EACH_ROW,
        BEFORE=backward_source.LOAD_BEGIN,
        ROW=backward_source.LOAD,
        AFTER=backward_source.LOAD_END,
    )
    + _splats(
        "__builtin_prefetch(partials_ + (long long)indices_[2 * ahead + 1] * stride, 1);",
        backward_source.COMPOSITE,
        BEFORE=backward_source.BEFORE,
        STRIP_END=backward_source.STRIP_END,
        STRIP=backward_source.STRIP,
        AFTER=backward_source.AFTER,
    ),
)
BACKWARD = "constexpr bool ABSOLUTE = false;" + _GRADIENTS
ABSOLUTE = "constexpr bool ABSOLUTE = true;" + _GRADIENTS  # absolute gradients, too
LANES = _filled(VECTORS, **_SIZES) + "*(int*)lanes.data = LANES;"
PREFETCH = r"""__builtin_prefetch((const float*)array.data + index);"""

# The index of the next work item, for workers that share `counters`.
NEXT_WORK_ITEM = (
    r"""return __atomic_fetch_add((int*)counters.data + counter, 1, __ATOMIC_RELAXED);"""
)

# Address of a function that runs a queue of compiled kernels; each thread of a pool calls it.
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
