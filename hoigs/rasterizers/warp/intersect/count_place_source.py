"""CUDA C++ of the kernels that count and place tile intersections.

The arguments are described in `cuda_kernels`.
"""

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

# The intersections of a block's splats, by splat, row of tiles and tile. Threads first share the
# rows of tiles, a block at a time, then the tiles of those, so that no thread waits for a splat
# that covers the whole image. INTERSECTION is done for FLIGHT intersections of a thread at a time,
# which are numbered `done + base_p + j BLOCK` in the block.
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
    if (row < count && depths_[row] > 0.0f) {
        Splat mine;
        under = mine.read(records_, row, tile_height, tiles_y);
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

COUNT = (
    _SPLAT
    + "__shared__ int totals[%(BLOCK)d]; totals[threadIdx.x] = 0;"
    + _INTERSECTIONS.replace("%(SPAN)s", "atomicAdd(&totals[owner], length);").replace(
        "%(INTERSECTION)s",
        r"""
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j)
                if (base_p + j * BLOCK < all) atomicAdd(counts_ + tile[j], 1);
""",
    )
    + r"""
    __syncthreads();
    int block_sum;
    const int total = totals[me], through = sum_before(total, block_sum);
    if (row < count) {
        ((int*)first_partial.data)[row] = through - total;  // PLACE adds what is before the block
        ((int*)tiles_per_gaussian.data)[row] = total;
    }
    if (me == 0) ((int*)sums.data)[row / BLOCK] = block_sum;
"""
)

PLACE = (
    _SPLAT
    + r"""
    const int* offsets_ = (const int*)offsets.data;
    if (offsets_[tiles_x * tiles_y + 1] >= 0) {  // a shared list: one partial per Gaussian
        if (row < count) {
            ((int*)first_partial.data)[row] = row;
            ((int*)tiles_per_gaussian.data)[row] = ((int*)tiles_per_gaussian.data)[row] > 0 ? 1 : 0;
        }
        return;
    }
    const int before = ((int*)sums.data)[row / %(BLOCK)d];
    if (row < count) ((int*)first_partial.data)[row] += before;
    unsigned long long* keys_ = (unsigned long long*)keys.data;
    int* owners_ = (int*)owners.data;
"""
    + _INTERSECTIONS.replace("%(SPAN)s", "").replace(
        "%(INTERSECTION)s",
        r"""
            int place[FLIGHT];
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j)
                if (base_p + j * BLOCK < all)
                    place[j] = offsets_[tile[j]] + atomicSub(counts_ + tile[j], 1) - 1;
            #pragma unroll
            for (int j = 0; j < FLIGHT; ++j) {
                if (base_p + j * BLOCK >= all) continue;
                const int partial = before + done + base_p + j * BLOCK, of = span_owners[span[j]];
                const unsigned depth = __float_as_int(splats[of].depth);
                keys_[place[j]] = (unsigned long long)depth << 32 | (unsigned)partial;
                owners_[partial] = row - me + of;
            }
""",
    )
)
