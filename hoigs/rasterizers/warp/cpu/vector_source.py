"""C++ of the native CPU kernels: vectors, the layout of a tile, the loop over tiles.

LLVM does not vectorise a compositing loop by itself, so vectors of LANES floats are written out
with Clang's extension, which becomes AVX-512 (16 lanes), or AVX2, SSE or NEON (8 lanes).

A tile is two *strips*, 8 pixels wide and `tile_height` (at most MAX_ROWS) high. A strip is a column
of *blocks*, one vector each, of 8 pixels by HIGH rows: 2 with 16 lanes, 1 with 8. Narrow blocks fit
splats of some pixels better than rows of 16: a tenth to a quarter fewer of them are touched.
Lane i of block b in strip s is pixel (X + 8 s + i / HIGH, Y + HIGH b + i % HIGH). Its transmittance
T is kept negative once the pixel has stopped, and from the start for lanes outside the image.

The arguments are described in `native_kernels`. `float(x)` and `int(x)` are macros of Warp here:
casts are written (float)(x).
"""

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
