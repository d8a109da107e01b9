"""CUDA C++ of the kernels that list the splats of each tile, nearest first.

Nothing here waits for the host, and no kernel's size depends on how many pairs there are:

    COUNT    a thread a Gaussian: how many tiles its ellipse touches, and one more for each of them
    PLAN     one block: running sums over tiles and Gaussians, and whether the pairs fit
    PLACE    a thread a Gaussian: its keys (depth, slot) into the lists of its tiles, in any order
    SORT     a block a tile: its keys by depth; slots rise with rows, so ties go by row

`counts` is zero before COUNT and after PLACE, which counts down where COUNT counted up.

When the pairs do not fit (`total > capacity`), PLAN sorts all drawn Gaussians into one list, which
every tile then walks, taking those whose box it touches. It is slower, never wrong. The length of
that list stands behind the offsets, -1 where each tile has its own.

Names of arguments stand in `list_kernels`.
"""

BLOCK = 256  # threads of COUNT and PLACE
PLAN_BLOCK = 1024
SORT_BLOCK = 128
SORTED_AT_ONCE = 2048  # keys that a block sorts in shared memory; longer lists are merged

# The tiles of one row of tiles under a splat; `tile_spans.span` in C++. Rounding is spelt out, so
# that COUNT and PLACE agree to the last bit.
_SPLAT = r"""
    struct Splat {
        float x, y, shear, half_width, half_height, slope, waist;
        int top, bottom;  // rows of tiles under its box

        __device__ void read(const float* records, int row, int rows, int down) {
            const float4* g = (const float4*)(records + 16ll * row);
            const float4 a = g[0], c = g[2], d = g[3];
            x = a.x; y = a.y; shear = a.w;
            half_width = c.z; half_height = c.w; slope = d.x; waist = d.z;
            top = tile_row(__fsub_rn(y, half_height), rows, down);
            bottom = tile_row(__fadd_rn(y, half_height), rows, down);
        }
        static __device__ int tile_row(float at, int rows, int down) {
            const float tile = floorf(__fdiv_rn(at, (float)rows));
            return (int)fminf(fmaxf(tile, 0.0f), (float)(down - 1));
        }
        __device__ int span(int ty, int rows, int across, int width, int& first) const {
            const float above = __fsub_rn((float)(ty * rows) + 0.5f, y);
            const float y0 = fmaxf(above, -half_height);
            const float y1 = fminf(__fadd_rn(above, (float)(rows - 1)), half_height);
            if (!(y0 <= y1)) return 0;
            const float far = __fmul_rn(slope, half_width);
            const float inverse = __frcp_rn(fmaxf(half_height, 1e-6f));
            const float yr = fminf(fmaxf(far, y0), y1), yl = fminf(fmaxf(-far, y0), y1);
            const float sr = __fmul_rn(yr, inverse), sl = __fmul_rn(yl, inverse);
            const float wr = __fsqrt_rn(fmaxf(__fmaf_rn(-sr, sr, 1.0f), 0.0f));
            const float wl = __fsqrt_rn(fmaxf(__fmaf_rn(-sl, sl, 1.0f), 0.0f));
            const float right = __fadd_rn(x, __fmaf_rn(waist, wr, __fmul_rn(shear, yr)));
            const float left = __fadd_rn(x, __fmaf_rn(-waist, wl, __fmul_rn(shear, yl)));
            const float edge = (float)width - 0.5f;
            if (!(right >= 0.5f && left <= edge)) return 0;
            first = (int)floorf(__fmul_rn(fmaxf(__fsub_rn(left, 0.5f), 0.0f), 1.0f / %(WIDTH)d.0f));
            int last = (int)floorf(__fmul_rn(__fsub_rn(fminf(right, edge), 0.5f),
                                             1.0f / %(WIDTH)d.0f));
            last = last < across - 1 ? last : across - 1;
            return last >= first ? last - first + 1 : 0;
        }
    };
    const float* records_ = (const float*)records.data;
    const float* depths_ = (const float*)drawn_depths.data;
    int* counts_ = (int*)counts.data;
    int* first_ = (int*)first.data;
    int* slots_ = (int*)slots.data;
    int* sums_ = (int*)sums.data;
    const int lane = threadIdx.x & 31;
    const int TALL = 8;  // rows of tiles; splats beyond are shared out among the lanes of a warp
"""

COUNT = (
    _SPLAT
    + r"""
    __shared__ int warp_sums[%(BLOCK)d / 32];
    const bool drawn = row < count && depths_[row < count ? row : 0] > 0.0f;
    Splat s;
    s.top = 0;
    s.bottom = -1;
    if (drawn) s.read(records_, row, rows, down);
    const bool tall = s.bottom - s.top >= TALL;
    int total = 0;
    if (!tall) {
        for (int ty = s.top; ty <= s.bottom; ++ty) {
            int from = 0;
            const int length = s.span(ty, rows, across, width, from);
            total += length;
            int* here = counts_ + ty * across + from;
            for (int k = 0; k < length; ++k) atomicAdd(here + k, 1);
        }
    }
    unsigned waiting = __ballot_sync(0xffffffffu, tall);
    while (waiting) {
        const int source = __ffs(waiting) - 1;
        waiting &= waiting - 1;
        Splat big;
        big.read(records_, __shfl_sync(0xffffffffu, row, source), rows, down);
        int mine = 0;
        for (int ty = big.top + lane; ty <= big.bottom; ty += 32) {
            int from = 0;
            const int length = big.span(ty, rows, across, width, from);
            mine += length;
            int* here = counts_ + ty * across + from;
            for (int k = 0; k < length; ++k) atomicAdd(here + k, 1);
        }
        for (int step = 16; step > 0; step /= 2) mine += __shfl_xor_sync(0xffffffffu, mine, step);
        if (lane == source) total = mine;
    }
    int through = total;  // sum over this row of the block and those before
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, through, step);
        if (lane >= step) through += other;
    }
    if (lane == 31) warp_sums[threadIdx.x / 32] = through;
    __syncthreads();
    int before = 0, all = 0;
    for (int w = 0; w < %(BLOCK)d / 32; ++w) {
        if (w < threadIdx.x / 32) before += warp_sums[w];
        all += warp_sums[w];
    }
    if (row < count) {
        first_[row] = before + through - total;  // within the block; PLACE adds what is before it
        slots_[row] = total;
    }
    if (threadIdx.x == 0) sums_[row / %(BLOCK)d] = all;
"""
)

PLACE = (
    _SPLAT
    + r"""
    const int* offsets_ = (const int*)offsets.data;
    unsigned long long* keys_ = (unsigned long long*)keys.data;
    int* owners_ = (int*)owners.data;
    const int number = row < count ? slots_[row] : 0;
    if (offsets_[across * down + 1] >= 0) {  // one list for all: the slot of a row is the row
        if (row < count) {
            first_[row] = row;
            slots_[row] = number > 0 ? 1 : 0;
        }
        return;
    }
    int slot = 0;
    unsigned long long depth = 0;
    Splat s;
    s.top = 0;
    s.bottom = -1;
    if (row < count) {
        slot = first_[row] + sums_[row / %(BLOCK)d];
        first_[row] = slot;
    }
    if (number > 0) {
        s.read(records_, row, rows, down);
        depth = (unsigned long long)(unsigned)__float_as_int(depths_[row]) << 32;
    }
    auto put = [&](int tile, unsigned long long key, int slot, int owner) {
        const int place = offsets_[tile] + atomicSub(counts_ + tile, 1) - 1;
        keys_[place] = key | (unsigned)slot;
        owners_[slot] = owner;
    };
    const bool tall = s.bottom - s.top >= TALL;
    if (!tall) {
        for (int ty = s.top; ty <= s.bottom; ++ty) {
            int from = 0;
            const int length = s.span(ty, rows, across, width, from);
            for (int k = 0; k < length; ++k) put(ty * across + from + k, depth, slot++, row);
        }
    }
    unsigned waiting = __ballot_sync(0xffffffffu, tall);
    while (waiting) {
        const int source = __ffs(waiting) - 1;
        waiting &= waiting - 1;
        const int owner = __shfl_sync(0xffffffffu, row, source);
        const unsigned long long key = __shfl_sync(0xffffffffu, depth, source);
        int next = __shfl_sync(0xffffffffu, slot, source);
        Splat big;
        big.read(records_, owner, rows, down);
        for (int base = big.top; base <= big.bottom; base += 32) {
            const int ty = base + lane;
            int from = 0;
            const int length = ty <= big.bottom ? big.span(ty, rows, across, width, from) : 0;
            int through = length;
            for (int step = 1; step < 32; step *= 2) {
                const int other = __shfl_up_sync(0xffffffffu, through, step);
                if (lane >= step) through += other;
            }
            for (int k = 0; k < length; ++k)
                put(ty * across + from + k, key, next + through - length + k, owner);
            next += __shfl_sync(0xffffffffu, through, 31);
        }
    }
"""
)

# Keys, all different, in ascending order. A list of up to SORTED_AT_ONCE keys is sorted in shared
# memory (bitonic); a longer one in such pieces, which are then merged, the two arrays taking turns.
# Every thread of the block calls it; returns the array that holds the result.
_SORTED = r"""
    typedef unsigned long long Key;
    constexpr int AT_ONCE = %(SORTED_AT_ONCE)d;
    __shared__ Key window[AT_ONCE];
    auto sorted = [&](Key* keys, Key* other, int n) -> Key* {
        const int threads = blockDim.x, me = threadIdx.x;
        for (int begin = 0; begin < n; begin += AT_ONCE) {
            const int here = n - begin < AT_ONCE ? n - begin : AT_ONCE;
            int size = 2;
            while (size < here) size *= 2;
            for (int i = me; i < size; i += threads)
                window[i] = i < here ? keys[begin + i] : ~0ull;
            __syncthreads();
            for (int run = 2; run <= size; run *= 2) {
                for (int step = run / 2; step > 0; step /= 2) {
                    for (int i = me; i < size / 2; i += threads) {
                        const int low = 2 * i - (i & (step - 1)), high = low + step;
                        const Key a = window[low], b = window[high];
                        if ((a > b) == ((low & run) == 0)) {
                            window[low] = b;
                            window[high] = a;
                        }
                    }
                    __syncthreads();
                }
            }
            for (int i = me; i < here; i += threads) keys[begin + i] = window[i];
            __syncthreads();
        }
        for (int run = AT_ONCE; run < n; run *= 2) {  // each thread writes a part of the merged
            const long long share = (n + threads - 1) / threads;
            long long at = me * share;
            const long long stop = at + share < n ? at + share : n;
            while (at < stop) {
                const long long left = at / (2ll * run) * (2ll * run);
                const long long middle = left + run < n ? left + run : n;
                const long long right = middle + run < n ? middle + run : n;
                const long long rank = at - left, wide = middle - left, tall = right - middle;
                long long low = rank > tall ? rank - tall : 0, high = rank < wide ? rank : wide;
                while (low < high) {  // how many of the first `rank` come from the left run
                    const long long half = (low + high) / 2;
                    if (keys[left + half] < keys[middle + rank - 1 - half]) low = half + 1;
                    else high = half;
                }
                long long a = left + low, b = middle + rank - low;
                const long long until = stop < right ? stop : right;
                for (; at < until; ++at)
                    other[at] = b >= right || (a < middle && keys[a] < keys[b]) ? keys[a++]
                                                                                : keys[b++];
            }
            __syncthreads();
            Key* swapped = keys;
            keys = other;
            other = swapped;
        }
        return keys;
    };
"""

PLAN = (
    _SORTED
    + r"""
    const float* depths_ = (const float*)drawn_depths.data;
    int* counts_ = (int*)counts.data;
    int* sums_ = (int*)sums.data;
    int* offsets_ = (int*)offsets.data;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    constexpr int EACH = 4;
    __shared__ long long warp_sums[32];
    // exclusive running sums of `from` into `to` (they may be the same); returns the sum of all
    auto scan = [&](const int* from, int* to, int n) -> long long {
        long long carry = 0;
        for (int base = 0; base < n; base += EACH * %(PLAN_BLOCK)d) {
            const int mine = base + EACH * threadIdx.x;
            int part[EACH];
            long long sum = 0;
            for (int j = 0; j < EACH; ++j) {
                part[j] = mine + j < n ? from[mine + j] : 0;
                sum += part[j];
            }
            long long through = sum;
            for (int step = 1; step < 32; step *= 2) {
                const long long other = __shfl_up_sync(0xffffffffu, through, step);
                if (lane >= step) through += other;
            }
            if (lane == 31) warp_sums[warp] = through;
            __syncthreads();
            const long long whole = warp_sums[lane];
            long long warps = whole;
            for (int step = 1; step < 32; step *= 2) {
                const long long other = __shfl_up_sync(0xffffffffu, warps, step);
                if (lane >= step) warps += other;
            }
            const long long before = __shfl_sync(0xffffffffu, warps - whole, warp);
            long long next = carry + before + through - sum;
            for (int j = 0; j < EACH; ++j) {
                if (mine + j < n) to[mine + j] = (int)next;
                next += part[j];
            }
            carry += __shfl_sync(0xffffffffu, warps, 31);
            __syncthreads();
        }
        return carry;
    };
    const long long total = scan(counts_, offsets_, tiles);
    const bool fits = total <= capacity;
    if (fits || measuring) {
        scan(sums_, sums_, (count + %(BLOCK)d - 1) / %(BLOCK)d);
    }
    if (threadIdx.x == 0) {
        offsets_[tiles] = total < 2147483647ll ? (int)total : 2147483647;
        offsets_[tiles + 1] = -1;
        long long* most = (long long*)seen.data;
        if (total > *most) *most = total;
        *(volatile long long*)told.data = *most;  // in the host's memory
    }
    if (fits || measuring) return;
    Key* keys_ = (Key*)keys.data;
    for (int tile = threadIdx.x; tile < tiles; tile += blockDim.x) counts_[tile] = 0;
    for (int row = threadIdx.x; row < count; row += blockDim.x)
        keys_[row] = depths_[row] > 0.0f
            ? (Key)(unsigned)__float_as_int(depths_[row]) << 32 | (unsigned)row : ~0ull;
    __syncthreads();
    const Key* order = sorted(keys_, (Key*)pairs.data, count);
    __shared__ int length;
    if (threadIdx.x == 0) length = 0;
    __syncthreads();
    for (int k = threadIdx.x; k < count; k += blockDim.x) {
        const Key key = order[k];
        if (key == ~0ull) continue;
        ((int2*)pairs.data)[k] = make_int2((int)(unsigned)key, (int)(unsigned)key);
        if (k == count - 1 || order[k + 1] == ~0ull) length = k + 1;
    }
    __syncthreads();
    if (threadIdx.x == 0) offsets_[tiles + 1] = length;
"""
)

SORT = (
    _SORTED
    + r"""
    const int* offsets_ = (const int*)offsets.data;
    const int* owners_ = (const int*)owners.data;
    if (offsets_[tiles + 1] >= 0) return;
    const int begin = offsets_[tile], n = offsets_[tile + 1] - begin;
    if (n == 0) return;
    Key* list = (Key*)pairs.data + begin;
    const Key* order = sorted((Key*)keys.data + begin, list, n);
    for (int k = threadIdx.x; k < n; k += blockDim.x) {
        const unsigned slot = (unsigned)order[k];
        ((int2*)list)[k] = make_int2(owners_[slot], (int)slot);
    }
"""
)
