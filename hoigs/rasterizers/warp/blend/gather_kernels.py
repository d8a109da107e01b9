# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""A CUDA kernel that sums the partial gradients; see `warp.records`."""

from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.records import F32, I32

wp.set_module_options({"enable_backward": False})

BLOCK = 256  # threads
ROWS = 64  # Gaussians of a block
BLOCK_C = wp.constant(BLOCK)

# The sums of a row's partials, in the place of the first of them, always in the same order. A warp
# takes `wide` of their numbers at a time, so lanes form groups, three where there are no features.
# A group adds up a row; where a row has more partials, the groups of a warp share it, and where it
# has very many, those of the block.
_GATHER = r"""
    constexpr int WARPS = %(BLOCK)d / 32, ROWS = %(ROWS)d, OWN = ROWS / WARPS;
    constexpr int FEW = 48, MANY = 512, AHEAD = 8;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    const int* first_partial_ = (const int*)first_partial.data;
    const int* tiles_per_gaussian_ = (const int*)tiles_per_gaussian.data;
    float* partials_ = (float*)partials.data;
    __shared__ int listed, taken, rows_listed[ROWS];
    __shared__ float parts[WARPS][32];
    if (threadIdx.x == 0) listed = taken = 0;
    __syncthreads();
    const int row = block * ROWS + warp * OWN + lane;
    const bool own = lane < OWN && row < count;
    const int own_first = own ? first_partial_[row] : 0;
    const int own_tiles = own ? tiles_per_gaussian_[row] : 0;
    if (own_tiles > FEW) rows_listed[atomicAdd(&listed, 1)] = row;
    if (own) ((int*)drawn.data)[row] = own_tiles > 0 ? 1 : 0;
    __syncthreads();

    for (int c = 0; c < stride; c += 32) {
        const int wide = stride - c < 32 ? stride - c : 32, groups = 32 / wide;
        const int group = lane / wide, column = c + lane - group * wide;
        // every `step`-th of n partials; AHEAD loads are in flight together
        auto sum = [&](const float* from, int n, int step) -> float {
            float total = 0.0f;
            for (; n > 0; n -= AHEAD * step, from += (long long)AHEAD * step * stride) {
                float values[AHEAD];
                const float* at = from;
                #pragma unroll
                for (int j = 0; j < AHEAD; ++j, at += step * stride)
                    values[j] = j * step < n ? *at : 0.0f;
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
        for (int r = 0; r < OWN; r += groups) {
            const int source = r + group < OWN ? r + group : 31;
            const int n = __shfl_sync(0xffffffffu, own_tiles, source);
            const int at = __shfl_sync(0xffffffffu, own_first, source);
            if (group < groups && n > 1 && n <= FEW) {
                float* to = partials_ + (long long)at * stride + column;
                *to = sum(to, n, 1);
            }
        }
        if (threadIdx.x == 0) taken = 0;
        __syncthreads();
        for (;;) {  // the warps take turns
            int k = 0;
            if (lane == 0) k = atomicAdd(&taken, 1);
            k = __shfl_sync(0xffffffffu, k, 0);
            if (k >= listed) break;
            const int n = tiles_per_gaussian_[rows_listed[k]];
            if (n > MANY) continue;
            float* to = partials_ + (long long)first_partial_[rows_listed[k]] * stride + column;
            const float mine = group < groups ? sum(to + group * stride, n - group, groups) : 0.0f;
            const float total = sum_of_groups(mine);
            __syncwarp();
            if (group == 0) *to = total;
        }
        for (int k = 0; k < listed; ++k) {  // all warps together
            const int n = tiles_per_gaussian_[rows_listed[k]];
            if (n <= MANY) continue;
            float* to = partials_ + (long long)first_partial_[rows_listed[k]] * stride + column;
            const int begin = warp * groups + group;
            const float mine =
                group < groups ? sum(to + begin * stride, n - begin, WARPS * groups) : 0.0f;
            parts[warp][lane] = sum_of_groups(mine);
            __syncthreads();
            if (warp == 0 && group == 0) {
                float total = 0.0f;
                for (int w = 0; w < WARPS; ++w) total += parts[w][lane];
                *to = total;
            }
            __syncthreads();
        }
        __syncthreads();
    }
"""


@wp.func_native(_GATHER % {"BLOCK": BLOCK, "ROWS": ROWS})
def gather_native(
    block: int, count: int, stride: int, first_partial: I32, tiles_per_gaussian: I32,
    partials: F32, drawn: I32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def gather_partials(
    count: int,  # N; a block for each ROWS of them
    stride: int,
    first_partial: I32,
    tiles_per_gaussian: I32,
    partials: F32,  # the first of each Gaussian becomes the sum of all of its own
    drawn: I32,  # [N] 1 where there are partials, else 0
):
    gather_native(
        wp.tid() // BLOCK_C, count, stride, first_partial, tiles_per_gaussian, partials, drawn
    )
