"""CUDA C++ of the kernels that count, place and plan tile intersections, and of sorting them."""

from __future__ import annotations

BLOCK = 256  # threads

# The tiles of one row of tiles under a splat; `tile_spans.span` in C++. Rounding is explicit, so
# that COUNT and PLACE agree to the last bit.
_SPLAT = r"""
    struct Splat {
        float x, y, shear, half_width, half_height, slope, waist, depth;
        int top, before;  // first row of tiles under its box; rows of tiles of the splats before it

        __device__ int read(const float* records, int row, int tile_height, int tiles_y) {
            const float4* g = (const float4*)(records + 16ll * row);
            const float4 a = g[0], c = g[2], d = g[3];
            x = a.x; y = a.y; shear = a.w; depth = c.y;
            half_width = c.z; half_height = c.w; slope = d.x; waist = d.z;
            top = tile_row(__fsub_rn(y, half_height), tile_height, tiles_y);
            return tile_row(__fadd_rn(y, half_height), tile_height, tiles_y) - top + 1;
        }
        static __device__ int tile_row(float at, int tile_height, int tiles_y) {
            const float tile = floorf(__fdiv_rn(at, (float)tile_height));
            return (int)fminf(fmaxf(tile, 0.0f), (float)(tiles_y - 1));
        }
        // whether one of few tiles under its box is open; true where they are many
        __device__ bool meets(const int* open, int rows, int tiles_x) const {
            constexpr float TILE = 1.0f / %(WIDTH)d.0f;  // one pixel more: rounding loses nothing
            const int first = (int)fmaxf((x - half_width - 1.0f) * TILE, 0.0f);
            const int last = (int)fminf((x + half_width + 1.0f) * TILE, (float)(tiles_x - 1));
            if (rows * (last - first + 1) > 64) return true;
            for (int ty = top; ty < top + rows; ++ty)
                for (int tx = first; tx <= last; ++tx)
                    if (open[ty * tiles_x + tx]) return true;
            return false;
        }
        __device__ int span(int ty, int tile_height, int tiles_x, int width, int& first) const {
            const float above = __fsub_rn((float)(ty * tile_height) + 0.5f, y);
            const float y0 = fmaxf(above, -half_height);
            const float y1 = fminf(__fadd_rn(above, (float)(tile_height - 1)), half_height);
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
            last = last < tiles_x - 1 ? last : tiles_x - 1;
            return last >= first ? last - first + 1 : 0;
        }
    };
"""

# What stands in `offsets`, whose parts `cuda_kernels` describes.
STATE = r"""
    int* offsets_ = (int*)offsets.data;
    int* shared_length = offsets_ + tiles + 1;
    int* order_ = offsets_ + tiles + 2;
    int* sorted_until_ = offsets_ + 2 * tiles + 2;
    int* others_ = offsets_ + 3 * tiles + 2;
    int* others_until_ = offsets_ + 4 * tiles + 3;
    int* open_ = offsets_ + 5 * tiles + 3;
    int* number_open = offsets_ + 6 * tiles + 3;
    int* restarted = number_open + 1;
    int* border = number_open + 2;
    int* partials_so_far = number_open + 3;
"""
STATE_SIZE = 7  # and six numbers a tile

# The nearest Gaussians are those whose depth's bits are less than `border`, a quantile of a sample:
# every block finds the same. EXACT bits of it are sought, below the sign.
_BORDER = r"""
    constexpr int EXACT = 20, NEAREST = 6;  // a sixth of them
    if (part == NEAR) {
        const float* from = (const float*)drawn_depths.data;
        const float depth = from[(long long)threadIdx.x * count / BLOCK];
        const int bits = __float_as_int(depth);
        const int quantile = __syncthreads_count(depth > 0.0f) / NEAREST;
        int found = 0;
        for (int bit = 30; bit > 30 - EXACT; --bit)
            if (__syncthreads_count(depth > 0.0f && bits < (found | 1 << bit)) <= quantile)
                found |= 1 << bit;
        if (row == 0) *border = found;
        limit = found;
    }
"""

# The intersections of a block's splats, by splat, row of tiles and tile. Threads first share the
# rows of tiles, a block at a time, then the tiles of those, so that no thread waits for a splat
# that covers the whole image. INTERSECTION is done for FLIGHT intersections of a thread at a time,
# which are numbered `done + base_p + j BLOCK` in the block. Of the others than the nearest, rows of
# tiles under a splat are left out where none of the tiles is open.
_INTERSECTIONS = r"""
    constexpr int BLOCK = %(BLOCK)d, WARPS = BLOCK / 32, FLIGHT = 4;
    const int me = threadIdx.x, lane = me & 31, warp = me >> 5;
    __shared__ int warp_sums[WARPS];
    auto sum_before = [&](int value, int& all) -> int {  // of the threads before and this one
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(0xffffffffu, value, step);
            if (lane >= step) value += other;
        }
        __syncthreads();
        if (lane == 31) warp_sums[warp] = value;
        __syncthreads();
        all = 0;
        #pragma unroll
        for (int w = 0; w < WARPS; ++w) {
            if (w < warp) value += warp_sums[w];
            all += warp_sums[w];
        }
        return value;
    };
    auto search = [](const int* ends, int at) -> int {  // the first whose end is beyond
        int found = 0;
        #pragma unroll
        for (int step = BLOCK / 2; step > 0; step /= 2)
            if (ends[found + step - 1] <= at) found += step;
        return found;
    };
    __shared__ Splat splats[BLOCK];
    __shared__ int row_ends[BLOCK], span_ends[BLOCK], spans[BLOCK], span_owners[BLOCK];
    const float* records_ = (const float*)records.data;
    const float* depths_ = (const float*)drawn_depths.data;
    int* counts_ = (int*)counts.data;
    int under = 0, all_rows, done = 0;
    const float depth = row < count ? depths_[row] : -1.0f;
    const bool takes_part = depth > 0.0f
        && (part == ALL || (__float_as_int(depth) < limit) == (part == NEAR));
    if (takes_part && %(KNOWN)s) {
        Splat mine;
        under = mine.read(records_, row, tile_height, tiles_y);
        if (part == OTHERS && !mine.meets(open_, under, tiles_x)) under = 0;
        splats[me] = mine;
    }
    const int row_end = sum_before(under, all_rows);
    splats[me].before = row_end - under;
    row_ends[me] = row_end;
    __syncthreads();
    for (int base = 0; base < all_rows; base += BLOCK) {
        int length = 0, tile = 0, owner = 0;
        if (base + me < all_rows) {
            owner = search(row_ends, base + me);
            const Splat& splat = splats[owner];
            const int ty = splat.top + base + me - splat.before;
            int from = 0;
            length = splat.span(ty, tile_height, tiles_x, width, from);
            tile = ty * tiles_x + from;
            if (part == OTHERS) {
                bool open = false;
                for (int k = 0; k < length && !open; ++k) open = open_[tile + k] != 0;
                if (!open) length = 0;
            }
            %(SPAN)s
        }
        int all;
        const int end = sum_before(length, all);
        span_ends[me] = end;
        spans[me] = tile - (end - length);
        span_owners[me] = owner;
        __syncthreads();
        for (int base_p = me; base_p < all; base_p += FLIGHT * BLOCK) {
            int span[FLIGHT], tile[FLIGHT];
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j) {
                const int p = base_p + j * BLOCK;
                span[j] = search(span_ends, p < all ? p : 0);
                tile[j] = spans[span[j]] + p;
            }
            %(INTERSECTION)s
        }
        done += all;
    }
"""
_PARTS = STATE.replace("tiles", "tiles_x * tiles_y") + "enum { ALL, NEAR, OTHERS };"
COUNT = (
    _PARTS
    + r"""
    if (part == OTHERS && *number_open == 0) return;
    int limit = *border;
"""
    + _BORDER.replace("BLOCK", "%(BLOCK)d")
    + _SPLAT
    + "__shared__ int totals[%(BLOCK)d]; totals[threadIdx.x] = 0;"
    + _INTERSECTIONS.replace("%(SPAN)s", "atomicAdd(&totals[owner], length);")
    .replace("%(KNOWN)s", "true")
    .replace(
        "%(INTERSECTION)s",
        r"""
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j)
                if (base_p + j * BLOCK < all && (part != OTHERS || open_[tile[j]]))
                    atomicAdd(counts_ + tile[j], 1);
""",
    )
    + r"""
    __syncthreads();
    int block_sum;
    const int total = totals[me], through = sum_before(total, block_sum);
    if (part == OTHERS ? takes_part : row < count) {
        ((int*)first_partial.data)[row] = through - total;  // PLACE adds what is before the block
        ((int*)tiles_per_gaussian.data)[row] = total;
    }
    if (me == 0) ((int*)sums.data)[row / BLOCK] = block_sum;
"""
)
PLACE = (
    _PARTS
    + _SPLAT
    + r"""
    if (part == OTHERS && *number_open == 0) return;
    if (*shared_length >= 0) {  // one partial per Gaussian
        if (row < count) {
            ((int*)first_partial.data)[row] = row;
            ((int*)tiles_per_gaussian.data)[row] = ((float*)drawn_depths.data)[row] > 0.0f ? 1 : 0;
        }
        return;
    }
    const int limit = *border, before = ((int*)sums.data)[row / %(BLOCK)d];
    const int* begins = part == OTHERS ? others_ : offsets_;
    unsigned long long* keys_ = (unsigned long long*)keys.data;
    int* owners_ = (int*)owners.data;
"""
    + _INTERSECTIONS.replace("%(SPAN)s", "")
    .replace("%(KNOWN)s", "((const int*)tiles_per_gaussian.data)[row] > 0")
    .replace(
        "%(INTERSECTION)s",
        r"""
            int place[FLIGHT];
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j) {
                place[j] = -1;
                if (base_p + j * BLOCK < all && (part != OTHERS || open_[tile[j]]))
                    place[j] = begins[tile[j]] + atomicSub(counts_ + tile[j], 1) - 1;
            }
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j) {
                if (place[j] < 0) continue;
                const int partial = before + done + base_p + j * BLOCK, of = span_owners[span[j]];
                const unsigned depth = __float_as_int(splats[of].depth);
                keys_[place[j]] = (unsigned long long)depth << 32 | (unsigned)partial;
                owners_[partial] = row - me + of;
            }
""",
    )
    + "if (takes_part) ((int*)first_partial.data)[row] += before;"
)


# CUDA C++ of the kernel that plans the lists of tile intersections, and of what sorts them.
#
# The arguments are described in `cuda_kernels`.

PLAN_BLOCK = 1024  # threads

# Sorting keys, all different, by one warp: up to 32 N in registers, N neighbours in each lane, by a
# bitonic network over them and, by shuffles, over the lanes. `get` and `put` are given places.
IN_REGISTERS = r"""
    typedef unsigned long long Key;
    struct K1 { enum { N = 1 }; };
    struct K2 { enum { N = 2 }; };
    struct K4 { enum { N = 4 }; };
    struct K8 { enum { N = 8 }; };
    struct K16 { enum { N = 16 }; };
    auto sort_in_registers = [&](auto kind, int n, auto get, auto put) {
        constexpr int N = decltype(kind)::N;
        Key key[N];
        #pragma unroll
        for (int j = 0; j < N; ++j) key[j] = 32 * j + lane < n ? get(32 * j + lane) : ~0ull;
        #pragma unroll
        for (int run = 2; run <= 32 * N; run *= 2) {
            #pragma unroll
            for (int step = run / 2; step >= N; step /= 2) {
                const int other = step / N;  // lanes away
                const bool upper = lane & other, down = (lane * N) & run;
                #pragma unroll
                for (int j = 0; j < N; ++j) {
                    const Key theirs = __shfl_xor_sync(0xffffffffu, key[j], other);
                    if ((theirs < key[j]) == (upper == down)) key[j] = theirs;
                }
            }
            #pragma unroll
            for (int step = run / 2 < N / 2 ? run / 2 : N / 2; step > 0; step /= 2) {
                #pragma unroll
                for (int j = 0; j < N; ++j) {
                    if (j & step) continue;
                    const bool down = (lane * N + j) & run;
                    const Key a = key[j], b = key[j + step];
                    if ((b < a) != down) {
                        key[j] = b;
                        key[j + step] = a;
                    }
                }
            }
        }
        __syncwarp();  // all have been got
        #pragma unroll
        for (int j = 0; j < N; ++j)
            if (lane * N + j < n) put(lane * N + j, key[j]);
    };
"""

# By a block: windows in shared memory, a piece for each of eight warps, and the pieces merged;
# longer lists are windows merged, where the two arrays take turns. Every thread of the block calls
# `sorted`, which returns the array that holds the result. THREADS, of the block, stands before.
_SORTED = (
    r"""
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
"""
    + IN_REGISTERS
    + r"""
    constexpr int LONGEST = 256, PIECES = 8, WINDOW = PIECES * LONGEST, EACH = WINDOW / THREADS;
    // `number` keys of the merged runs [left, middle) and [middle, right), from the rank-th on
    auto merge = [](const Key* from, auto left, auto middle, auto right, auto rank, auto number,
                    auto put) {
        const auto wide = middle - left, tall = right - middle;
        auto low = rank > tall ? rank - tall : 0, high = rank < wide ? rank : wide;
        while (low < high) {  // how many of the first `rank` come from the left run
            const auto half = (low + high) / 2;
            if (from[left + half] < from[middle + rank - 1 - half]) low = half + 1;
            else high = half;
        }
        auto a = left + low, b = middle + rank - low;
        for (int j = 0; j < number; ++j)
            put(j, b >= right || (a < middle && from[a] < from[b]) ? from[a++] : from[b++]);
    };
    __shared__ Key window[WINDOW];
    auto sorted = [&](Key* keys, Key* other, int n) -> Key* {
        for (int begin = 0; begin < n; begin += WINDOW) {
            const int here = n - begin < WINDOW ? n - begin : WINDOW;
            const int piece = here > 4 * LONGEST ? LONGEST : here > 2 * LONGEST ? LONGEST / 2
                                                           : LONGEST / 4;
            const int mine = here - warp * piece;  // keys from this warp's piece on
            auto get = [&](int k) { return keys[begin + warp * piece + k]; };
            auto put = [&](int k, Key key) { window[warp * piece + k] = key; };
            if (warp < PIECES && mine > 0) {
                if (piece == LONGEST) sort_in_registers(K8(), mine, get, put);
                else if (piece == LONGEST / 2) sort_in_registers(K4(), mine, get, put);
                else sort_in_registers(K2(), mine, get, put);
            }
            __syncthreads();
            for (int run = piece; run < here; run *= 2) {
                Key part[EACH];
                const int at = EACH * threadIdx.x, left = at / (2 * run) * (2 * run);
                const int number = here - at < EACH ? here - at : EACH;
                const int middle = left + run < here ? left + run : here;
                const int right = middle + run < here ? middle + run : here;
                if (number > 0)
                    merge(window, left, middle, right, at - left, number,
                          [&](int j, Key key) { part[j] = key; });
                __syncthreads();
                #pragma unroll
                for (int j = 0; j < EACH; ++j)
                    if (j < number) window[at + j] = part[j];
                __syncthreads();
            }
            for (int i = threadIdx.x; i < here; i += THREADS) keys[begin + i] = window[i];
            __syncthreads();
        }
        for (int run = WINDOW; run < n; run *= 2) {  // each thread writes a share of the merged
            const long long share = (n + THREADS - 1) / THREADS, from = threadIdx.x * share;
            const long long stop = from + share < n ? from + share : n;
            for (long long at = from; at < stop;) {
                const long long left = at / (2ll * run) * (2ll * run);
                const long long middle = left + run < n ? left + run : n;
                const long long right = middle + run < n ? middle + run : n;
                const long long until = stop < right ? stop : right;
                merge(keys, left, middle, right, at - left, until - at,
                      [&](int j, Key key) { other[at + j] = key; });
                at = until;
            }
            __syncthreads();
            Key* swapped = keys;
            keys = other;
            other = swapped;
        }
        return keys;
    };
"""
)
PLAN = (
    "constexpr int THREADS = %(PLAN_BLOCK)d;"
    + _SORTED
    + STATE
    + r"""
    const bool others = part == 2;
    if (others && *number_open == 0) return;
    const float* depths_ = (const float*)drawn_depths.data;
    int* counts_ = (int*)counts.data;
    int* sums_ = (int*)sums.data;
    constexpr int ITEMS = 4;
    __shared__ long long warp_sums[32];
    // exclusive running sums of `from` into `to` (they may be the same), from `carry` on; returns
    // the sum of all
    auto scan = [&](const int* from, int* to, int n, long long carry) -> long long {
        for (int base = 0; base < n; base += ITEMS * %(PLAN_BLOCK)d) {
            const int mine = base + ITEMS * threadIdx.x;
            int part[ITEMS];
            long long sum = 0;
            for (int j = 0; j < ITEMS; ++j) {
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
            for (int j = 0; j < ITEMS; ++j) {
                if (mine + j < n) to[mine + j] = (int)next;
                next += part[j];
            }
            carry += __shfl_sync(0xffffffffu, warps, 31);
            __syncthreads();
        }
        return carry;
    };
    // the nearest have a partial for each intersection; of those of others, some have no open tile
    const int before = others ? *partials_so_far : 0;
    int* begins = others ? others_ : offsets_;
    const long long intersections = scan(counts_, begins, tiles, before);
    const long long total = scan(sums_, sums_, (count + %(BLOCK)d - 1) / %(BLOCK)d, before);
    const bool fits = total <= capacity;
    if (threadIdx.x == 0) {
        begins[tiles] = intersections < 2147483647ll ? (int)intersections : 2147483647;
        *partials_so_far = total < 2147483647ll ? (int)total : 2147483647;
        *restarted = others && !fits;
        if (!others) {
            *shared_length = -1;
            *number_open = 0;
        }
        long long* most = (long long*)largest.data;
        if (total > *most) *most = total;
        *(volatile long long*)largest_on_host.data = *most;  // in the host's memory
    }
    // tiles are drawn in this order: longest lists first
    constexpr int CLASSES = 64;
    __shared__ int places[CLASSES];
    auto class_of = [&](int tile) -> int {
        const int length = (counts_[tile] + 31) / 32;
        return CLASSES - 1 - (length < CLASSES - 1 ? length : CLASSES - 1);
    };
    if (threadIdx.x < CLASSES) places[threadIdx.x] = 0;
    __syncthreads();
    for (int tile = threadIdx.x; tile < tiles; tile += THREADS)
        atomicAdd(&places[class_of(tile)], 1);
    __syncthreads();
    if (threadIdx.x == 0) {
        for (int c = 0, before = 0; c < CLASSES; ++c) {
            const int here = places[c];
            places[c] = before;
            before += here;
        }
    }
    __syncthreads();
    for (int tile = threadIdx.x; tile < tiles; tile += THREADS)
        order_[atomicAdd(&places[class_of(tile)], 1)] = tile;
    if (fits || measuring) return;
    __syncthreads();
    Key* keys_ = (Key*)keys.data;
    for (int tile = threadIdx.x; tile < tiles; tile += blockDim.x) counts_[tile] = 0;
    for (int row = threadIdx.x; row < count; row += blockDim.x)
        keys_[row] = depths_[row] > 0.0f
            ? (Key)(unsigned)__float_as_int(depths_[row]) << 32 | (unsigned)row : ~0ull;
    __syncthreads();
    const Key* order = sorted(keys_, (Key*)indices.data, count);
    __shared__ int length;
    if (threadIdx.x == 0) length = 0;
    __syncthreads();
    for (int k = threadIdx.x; k < count; k += blockDim.x) {
        const Key key = order[k];
        if (key == ~0ull) continue;
        ((int2*)indices.data)[k] = make_int2((int)(unsigned)key, (int)(unsigned)key);
        if (k == count - 1 || order[k + 1] == ~0ull) length = k + 1;
    }
    __syncthreads();
    if (threadIdx.x == 0) *shared_length = length;
"""
)
