# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""CUDA kernels that clear and sum the partial gradients; see `warp.records`."""

from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.records import F32, I32, U8

wp.set_module_options({"enable_backward": False})

BLOCK = 256  # threads
ROWS = BLOCK  # Gaussians of a block
BLOCK_C = wp.constant(BLOCK)

# The sums of a row's partials, always in the same order. They are put where the gradients of the
# same Gaussian will be, and wait there for the adjoint: so they take no memory of their own, and
# that of the partials is free. Partials that were not written, most where much is hidden, are not
# read. A warp takes `wide` of their numbers at a time, so lanes form groups, three where there are
# no features. A group adds up a row; where a row has more partials, the groups of a warp share it,
# and where it has very many, those of the block.
_GATHER = r"""
    constexpr int WARPS = %(BLOCK)d / 32, ROWS = %(ROWS)d;
    constexpr int FEW = 48, MANY = 512, AHEAD = 8;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const int* first_partial_ = (const int*)first_partial.data;
    const int* tiles_per_gaussian_ = (const int*)tiles_per_gaussian.data;
    const float* partials_ = (const float*)partials.data;
    const unsigned char* written_ = (const unsigned char*)written.data;
    int* drawn_ = (int*)drawn.data;
    __shared__ int listed, taken, rows_listed[ROWS];
    __shared__ float parts[WARPS][32];
    if (threadIdx.x == 0) listed = taken = 0;
    __syncthreads();
    const int row = block * ROWS + threadIdx.x;
    const bool own = row < count;
    const int own_first = own ? first_partial_[row] : 0;
    const int own_tiles = own ? tiles_per_gaussian_[row] : 0;
    if (own_tiles > FEW) rows_listed[atomicAdd(&listed, 1)] = row;
    // which partials of the lane's row were written, as bits
    static_assert(FEW <= 64 - 8, "there are 64 bits");
    unsigned long long own_bits = 0;
    if (own_tiles > 0 && own_tiles <= FEW) {
        const int before = own_first & 7;  // marks in the first of the words of eight
        const unsigned long long* words =
            (const unsigned long long*)(written_ + own_first - before);
        #pragma unroll 4
        for (int j = 0; j < before + own_tiles; j += 8)  // the product gathers the lowest bits
            own_bits |= words[j / 8] * 0x0102040810204080ull >> 56 << j;
        own_bits = own_bits >> before & ((1ull << own_tiles) - 1);
    }
    if (own && own_tiles <= FEW) drawn_[row] = own_bits != 0;
    __syncthreads();

    for (int c = 0; c < stride; c += 32) {
        const int wide = stride - c < 32 ? stride - c : 32, groups = 32 / wide;
        const int group = lane / wide, column = c + lane - group * wide;
        float* to;  // the sum of this column, of the first row, and how many numbers a row has
        int width;
        if (column < 3) { to = (float*)v_means.data + column; width = 3; }
        else if (column < 6) { to = (float*)v_quats.data + column - 3; width = 4; }
        else if (column < 9) { to = (float*)v_log_scales.data + column - 6; width = 3; }
        else if (column == 9) { to = (float*)v_quats.data + 3; width = 4; }
        else if (column < 10 + channels) {
            to = (float*)v_features.data + column - 10;
            width = channels;
        } else { to = (float*)v_absolutes.data + column - 10 - channels; width = 2; }
        auto put = [&](int of, float total) { to[(long long)of * width] = total; };
        // every `step`-th of n partials from `at` on; AHEAD loads are in flight together
        auto sum = [&](int at, int n, int step, bool& some) -> float {
            const float* from = partials_ + (long long)at * stride + column;
            const unsigned char* mark = written_ + at;
            float total = 0.0f;
            for (; n > 0; n -= AHEAD * step, mark += AHEAD * step,
                          from += (long long)AHEAD * step * stride) {
                bool there[AHEAD];
                float values[AHEAD];
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j) there[j] = j * step < n && mark[j * step];
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j) {
                    values[j] = there[j] ? from[(long long)j * step * stride] : 0.0f;
                    some |= there[j];
                }
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j) total += values[j];
            }
            return total;
        };
        auto sum_of_groups = [&](float value) -> float {  // in the lanes of the first group
            float total = value;
            for (int g = 1; g < groups; ++g)
                total += __shfl_sync(0xffffffffu, value, (lane + g * wide) & 31);
            return total;
        };
        unsigned rows = __ballot_sync(0xffffffffu, own_bits != 0);
        while (rows != 0) {
            int source = -1;  // the group's own row of the next ones
            for (int g = 0; g < groups; ++g) {
                if (g == group && rows != 0) source = __ffs(rows) - 1;
                rows &= rows - 1;
            }
            unsigned long long bits = __shfl_sync(0xffffffffu, own_bits, source & 31);
            const int at = __shfl_sync(0xffffffffu, own_first, source & 31);
            if (source < 0) continue;
            const float* from = partials_ + (long long)at * stride + column;
            float total = 0.0f;
            while (bits != 0) {
                float values[AHEAD];
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j) {
                    values[j] = bits != 0 ? from[(long long)(__ffsll(bits) - 1) * stride] : 0.0f;
                    bits &= bits - 1;
                }
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j) total += values[j];
            }
            put(row - lane + source, total);
        }
        if (threadIdx.x == 0) taken = 0;
        __syncthreads();
        for (;;) {  // the warps take turns
            int k = 0;
            if (lane == 0) k = atomicAdd(&taken, 1);
            k = __shfl_sync(0xffffffffu, k, 0);
            if (k >= listed) break;
            const int of = rows_listed[k], n = tiles_per_gaussian_[of], at = first_partial_[of];
            if (n > MANY) continue;
            bool some = false;
            const float mine = group < groups ? sum(at + group, n - group, groups, some) : 0.0f;
            const float total = sum_of_groups(mine);
            some = __any_sync(0xffffffffu, some);
            if (group == 0 && some) put(of, total);
            if (lane == 0 && c == 0) drawn_[of] = some;
        }
        for (int k = 0; k < listed; ++k) {  // all warps together
            const int of = rows_listed[k], n = tiles_per_gaussian_[of], at = first_partial_[of];
            if (n <= MANY) continue;
            const int begin = warp * groups + group;
            bool some = false;
            const float mine =
                group < groups ? sum(at + begin, n - begin, WARPS * groups, some) : 0.0f;
            parts[warp][lane] = sum_of_groups(mine);
            some = __syncthreads_or(some);
            if (warp == 0 && group == 0 && some) {
                float total = 0.0f;
                for (int w = 0; w < WARPS; ++w) total += parts[w][lane];
                put(of, total);
            }
            if (threadIdx.x == 0 && c == 0) drawn_[of] = some;
            __syncthreads();
        }
        __syncthreads();
    }
"""


@wp.func_native(_GATHER % {"BLOCK": BLOCK, "ROWS": ROWS})
def gather_native(
    block: int, count: int, stride: int, channels: int, first_partial: I32, tiles_per_gaussian: I32,
    written: U8, partials: F32, v_means: F32, v_quats: F32, v_log_scales: F32, v_features: F32,
    v_absolutes: F32, drawn: I32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def gather_partials(
    count: int,  # N; a block for each ROWS of them
    stride: int,
    channels: int,
    first_partial: I32,
    tiles_per_gaussian: I32,
    written: U8,  # [intersections] 1 where a partial was written
    partials: F32,
    # of a Gaussian with partials that were written, their sums
    v_means: F32,  # [N, 3] M_G, M_U, M_Y
    v_quats: F32,  # [N, 4] M_UU, M_UY, M_YY, depth
    v_log_scales: F32,  # [N, 3] M_RED and the next
    v_features: F32,  # [N, channels] themselves
    v_absolutes: F32,  # [N, ABSOLUTES] themselves, where the partials have them
    drawn: I32,  # [N] 1 where there are some, else 0
):
    gather_native(
        wp.tid() // BLOCK_C, count, stride, channels, first_partial, tiles_per_gaussian, written,
        partials, v_means, v_quats, v_log_scales, v_features, v_absolutes, drawn,
    )  # fmt: skip


# Where all tiles share one list, the sums of each Gaussian grow by atomics, from zero.
_CLEAR = r"""
    if (thread < words) ((int4*)written.data)[thread] = make_int4(0, 0, 0, 0);
    if (((const int*)offsets.data)[tiles + 1] < 0) return;
    for (long long i = thread; i < (long long)count * stride; i += words)
        ((float*)partials.data)[i] = 0.0f;
"""


@wp.func_native(_CLEAR)
def clear_native(
    thread: int, words: int, count: int, stride: int, tiles: int, offsets: I32, written: U8,
    partials: F32,
): ...  # fmt: skip


@wp.kernel
def clear_partials(
    count: int,  # N
    stride: int, tiles: int, offsets: I32,
    written: U8,  # [16 words] becomes 0
    partials: F32,
    base: int, words: int,
):  # fmt: skip
    thread = wp.tid() + base
    if thread < words:
        clear_native(thread, words, count, stride, tiles, offsets, written, partials)
