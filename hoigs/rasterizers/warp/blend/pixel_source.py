"""C++ of the pixel kernels: for CUDA, and the same code for a CPU, so that tests can run it.

A warp of 32 lanes blends a tile, TILE_WIDTH pixels wide and TILE_HEIGHT high; a lane owns PIXELS
pixels of one column. The warp fetches 32 records at a time into shared memory. The ten sums of a
splat's gradient over the tile take 12 shuffles: each exchange also halves how many sums a lane
keeps. There are no barriers beyond the warp and no atomics, and sums have the same order in every
run.

On CUDA the forward pass sorts a tile's intersections by depth, a chunk at a time, and only as many
as it draws: where much is hidden, that is the twentieth part. It writes them where the backward
pass reads them.

On CUDA all tiles may share one list of Gaussians instead (see `warp.cuda.intersections`). Of each
32, the warp then takes those whose box touches its tile, and adds its sums by atomics.

Absolute gradients (ABSOLUTE) need a pixel's slope from all channels together. There the first pass
has all of it, and the passes for features sum only the features' own gradients.

On a CPU the lanes run one after the other, and each adds its own share to the partials.
The arguments are described in `pixel_kernels`.
"""

from hoigs.rasterizers.warp.intersect.cuda_source import IN_REGISTERS, STATE
from hoigs.rasterizers.warp.intersect.tile_spans import TILE_WIDTH

LANES = 32
PIXELS = 4
TILE_HEIGHT = LANES // TILE_WIDTH * PIXELS
WARPS = 4  # of a block

_HEAD = r"""
    constexpr int P = %(PIXELS)d, STEP = 32 / %(TILE_WIDTH)d;  // rows between a lane's pixels
    const int lane = thread & 31;
#if defined(__CUDA_ARCH__)
    %(STATE)s
    const int tile = order_[thread >> 5];
#else
    const int* offsets_ = (const int*)offsets.data;
    const int tile = thread >> 5;
#endif
    const int left = tile %% tiles_x * %(TILE_WIDTH)d, top = tile / tiles_x * %(TILE_HEIGHT)d;
    const int x = left + lane %% %(TILE_WIDTH)d, y = top + lane / %(TILE_WIDTH)d;
    const float* records_ = (const float*)records.data;
    const float* features_ = (const float*)features.data;
    const float* background_ = (const float*)background.data;
    int* indices_ = (int*)indices.data;
    float* color_ = (float*)color.data;
    float* alpha_ = (float*)alpha.data;
    float* depth_ = (float*)depth.data;
    float* feature_image_ = (float*)feature_image.data;
    int begin = offsets_[tile], end = offsets_[tile + 1];
#if defined(__CUDA_ARCH__)
    const unsigned ALL = 0xffffffffu;
    __shared__ float4 staged[%(WARPS)d * 32 * 3];
    float4* stage = staged + (threadIdx.x >> 5) * 32 * 3;
    const bool shared_list = *shared_length >= 0;
    if (shared_list) {
        begin = 0;
        end = *shared_length;
    }
    auto any = [&](bool here) -> bool { return __any_sync(ALL, here); };
    auto exp2_of = [](float e) -> float {
        float power;
        asm("ex2.approx.ftz.f32 %%0, %%1;" : "=f"(power) : "f"(e));
        return power;
    };
    auto quotient = [](float a, float b) -> float { return __fdividef(a, b); };
#else
    auto any = [](bool here) -> bool { return here; };
    auto exp2_of = [](float e) -> float { return wp::exp(e * 0.693147180559945309f); };
    auto quotient = [](float a, float b) -> float { return a / b; };
#endif
"""

# One pass over the intersections: colour and depth, or four feature channels from `channel` on.
_STATE = r"""
        float T[P];
        bool inside[P];
        #pragma unroll
        for (int i = 0; i < P; ++i) {
            inside[i] = x < width && y + i * STEP < height;
            T[i] = inside[i] ? 1.0f : -1.0f;  // negative: stopped
        }
"""

# Sorts the next of a tile's keys, and says how many: some hundred, all where that is less. They are
# those from `least` on and less than a bound, which a sample of the keys tells; where more than
# SIZE are, the bound is a quantile of those. Rows of 16 in `chunk` have a gap behind them, as a
# lane puts so many, one after the other, which would all lie in one bank. This is called, not
# inlined, since it takes more registers than drawing, and drawing is slow with so many.
_CHUNK = (
    r"""
    struct Chunk {
        typedef unsigned long long Key;
        enum { SIZE = 512, SAMPLE = 256, AIM = 192, FLIGHT = 4, LENGTH = SIZE + SIZE / 16 + 1 };
        static __device__ int slot(int i) { return i + i / 16; }
        // how many are kept with these
        static __device__ int keep(Key* chunk, Key key, bool wanted, int kept) {
            const unsigned all_wanted = __ballot_sync(0xffffffffu, wanted);
            const int to = kept + __popc(all_wanted & ((1u << (threadIdx.x & 31)) - 1u));
            if (wanted && to < SIZE) chunk[slot(to)] = key;
            return kept + __popc(all_wanted);
        }
        static __device__ __noinline__ void sort(Key* chunk, int n) {
            const int lane = threadIdx.x & 31;
"""
    + IN_REGISTERS
    + r"""
            __syncwarp();
            auto get = [&](int i) { return chunk[slot(i)]; };
            auto put = [&](int i, Key key) { chunk[slot(i)] = key; };
            if (n > 256) sort_in_registers(K16(), n, get, put);
            else if (n > 128) sort_in_registers(K8(), n, get, put);
            else if (n > 64) sort_in_registers(K4(), n, get, put);
            else if (n > 32) sort_in_registers(K2(), n, get, put);
            else sort_in_registers(K1(), n, get, put);
            __syncwarp();
        }
        // Gaussians and partials go to `to`; behind the chunk stands from where on keys are left
        static __device__ __noinline__ int sort_next(Key* chunk, const Key* keys, int2* to,
                                                     const int* owners, int number,
                                                     int number_sorted) {
            const int lane = threadIdx.x & 31, left_over = number - number_sorted;
            if (left_over == 0) return 0;
            const Key least = number_sorted > 0 ? chunk[LENGTH - 1] : 0;
            Key bound = ~0ull;
            if (left_over > SIZE) {
                int kept = 0;
                for (int j = 0; j < SAMPLE / 32; ++j) {
                    const Key key = keys[(long long)(32 * j + lane) * number / SAMPLE];
                    kept = keep(chunk, key, key >= least, kept);
                }
                if (kept > 1) {
                    sort(chunk, kept);
                    const int rank = AIM * kept / left_over;
                    bound = chunk[slot(rank > 1 ? rank : 1)];
                }
            }
            int found;
            for (;;) {
                __syncwarp();
                found = 0;
                for (int i = lane; i - lane < number; i += 32 * FLIGHT) {
                    Key key[FLIGHT];
                    #pragma unroll
                    for (int j = 0; j < FLIGHT; ++j)
                        key[j] = i + 32 * j < number ? keys[i + 32 * j] : ~0ull;
                    #pragma unroll
                    for (int j = 0; j < FLIGHT; ++j)
                        found = keep(chunk, key[j], key[j] >= least && key[j] < bound, found);
                }
                sort(chunk, found < SIZE ? found : SIZE);
                if (found <= SIZE) break;
                const int rank = (long long)AIM * SIZE / found;
                bound = chunk[slot(rank > 1 ? rank : 1)];
            }
            for (int i = lane; i < found; i += 32 * FLIGHT) {
                int partial[FLIGHT], owner[FLIGHT];
                #pragma unroll
                for (int j = 0; j < FLIGHT; ++j) {
                    if (i + 32 * j >= found) continue;
                    partial[j] = (int)chunk[slot(i + 32 * j)];
                    owner[j] = owners[partial[j]];
                }
                #pragma unroll
                for (int j = 0; j < FLIGHT; ++j)
                    if (i + 32 * j < found)
                        to[number_sorted + i + 32 * j] = make_int2(owner[j], partial[j]);
            }
            if (lane == 0) chunk[LENGTH - 1] = bound;
            __syncwarp();
            return found;
        }
    };
    __shared__ Chunk::Key chunks[%(WARPS)d * Chunk::LENGTH];
    __shared__ float put_aside[%(WARPS)d * 32 * P * 5];
    auto sort_next = [&](int number_sorted) -> int {
        const int from = others ? others_[tile] : offsets_[tile];
        return Chunk::sort_next(
            chunks + (threadIdx.x >> 5) * Chunk::LENGTH, (const Chunk::Key*)keys.data + from,
            (int2*)indices_ + from, (const int*)owners.data,
            (others ? others_ : offsets_)[tile + 1] - from, number_sorted);
    };
"""
)

# The loop over the tile's intersections, as long as some pixel goes on. It opens blocks that DONE
# closes; `continue` skips a splat. `exponent[i]` is log2 of alpha before the clamp, `on[i]` whether
# pixel i is hit.
_EACH = r"""
        int at = begin;
#if defined(__CUDA_ARCH__)
        #define DONE } at += 32; } }
        auto running = [&]() -> bool {
            bool some = false;
            #pragma unroll
            for (int i = 0; i < P; ++i) some |= T[i] > 0.0f;
            return any(some);
        };
        for (int stretch = 0; running(); ++stretch) {  // from `at` to `end` all are in order
            %(STRETCH)s
            int2 index;
            auto fetch = [&](int from) {
                if (from + lane < end) index = ((const int2*)indices_)[from + lane];
            };
            fetch(at);
            while (at < end && running()) {
                bool mine = at + lane < end;
                __syncwarp();  // the records before these have been read
                if (mine) {
                    const float4* record = (const float4*)records_ + 4ll * index.x;
                    const float4 first = record[0], third = record[2];
                    stage[3 * lane] = first;
                    stage[3 * lane + 1] = record[1];
                    stage[3 * lane + 2] = make_float4(third.x, third.y, __int_as_float(index.x),
                                                      __int_as_float(index.y));
                    if (shared_list)  // one pixel more than the box: rounding loses nothing
                        mine = first.x + third.z > (float)left - 1.0f
                            && first.x - third.z < (float)(left + %(TILE_WIDTH)d) + 1.0f
                            && first.y + third.w > (float)top - 1.0f
                            && first.y - third.w < (float)(top + %(TILE_HEIGHT)d) + 1.0f;
                }
                const unsigned taken = __ballot_sync(ALL, mine);
                __syncwarp();
                fetch(at + 32);  // on their way while these are drawn
                for (int k = 0; k < 32 - __clz(taken); ++k) {
                    if (shared_list && !(taken >> k & 1)) continue;
                const float4 g0 = stage[3 * k], g1 = stage[3 * k + 1], g2 = stage[3 * k + 2];
                const int row = __float_as_int(g2.z), partial = __float_as_int(g2.w);
#else
        #define DONE }
        struct Four { float x, y, z, w; };
        for (; at < end; ++at) {
                bool some = false;
                for (int i = 0; i < P; ++i) some |= T[i] > 0.0f;
                if (!some) break;
                const int row = indices_[2 * at], partial = indices_[2 * at + 1];
                const float* g = records_ + 16ll * row;
                const Four g0 = {g[0], g[1], g[2], g[3]}, g1 = {g[4], g[5], g[6], g[7]};
                const Four g2 = {g[8], g[9], 0.0f, 0.0f};
#endif
                (void)partial;
                const float dx = (float)x + 0.5f - g0.x, dy0 = (float)y + 0.5f - g0.y;
                const float a = g0.z, shear = g0.w, c = g1.x, log2_opacity = g1.y;
                float exponent[P], u[P];
                bool on[P], hit = false;
                #pragma unroll
                for (int i = 0; i < P; ++i) {
                    const float dy = dy0 + (float)(i * STEP);
                    u[i] = dx - shear * dy;
                    exponent[i] = log2_opacity - c * dy * dy - a * u[i] * u[i];
                    on[i] = exponent[i] >= log2_min_alpha && T[i] > 0.0f;
                    hit |= on[i];
                }
                if (!any(hit)) continue;
                float f[4] = {g1.z, g1.w, g2.x, g2.y};
                if (!COLOR)
                    for (int j = 0; j < 4; ++j)
                        f[j] = channel + j < channels ? features_[row * channels + channel + j]
                                                      : 0.0f;
"""

# How passes read on: the first one forward sorts what it draws, the others read what is sorted.
# What the nearest leave open is drawn once more when the others are there: their list follows. What
# the call of `sort_next` has to keep is put aside, or the loop that draws would be without
# registers for it.
_SORTING = r"""
            if (shared_list) {
                if (stretch > 0) break;
            } else if (others && stretch == 0) {
                end = sorted_until_[tile];
            } else {
                if (others && stretch == 1) end = others_[tile];
                if (!others && stretch == 0) end = begin;
                at = end;
                float* aside = put_aside + threadIdx.x;
                #pragma unroll
                for (int i = 0; i < P; ++i) {
                    aside[(5 * i + 4) * blockDim.x] = T[i];
                    for (int j = 0; j < 4; ++j) aside[(5 * i + j) * blockDim.x] = sums[i][j];
                }
                end += sort_next(at - (others ? others_[tile] : begin));
                #pragma unroll
                for (int i = 0; i < P; ++i) {
                    T[i] = aside[(5 * i + 4) * blockDim.x];
                    for (int j = 0; j < 4; ++j) sums[i][j] = aside[(5 * i + j) * blockDim.x];
                }
                if (at == end) break;
            }
"""
_SORTED = r"""
            if (stretch == 0) {
                if (!shared_list) end = sorted_until_[tile];
            } else {
                if (stretch == 2 || shared_list || !open_[tile]) break;
                at = others_[tile];
                end = others_until_[tile];
            }
"""

_FORWARD = r"""
        float sums[P][4] = {};
        %(EACH)s
                #pragma unroll
                for (int i = 0; i < P; ++i) {
                    if (!on[i]) continue;
                    const float raw = exp2_of(exponent[i]);
                    const float weight = T[i] * (raw < max_alpha ? raw : max_alpha);
                    const float next = T[i] - weight;
                    if (next > min_transmittance) {
                        T[i] = next;
                        for (int j = 0; j < 4; ++j) sums[i][j] += weight * f[j];
                    } else {
                        T[i] = -T[i];
                    }
                }
        DONE
        #undef DONE
#if defined(__CUDA_ARCH__)
        if (COLOR && lane == 0) (others ? others_until_ : sorted_until_)[tile] = end;
        if (COLOR && !others) {
            const bool open = part == 1 && !shared_list && running();
            if (lane == 0) {
                open_[tile] = open;
                if (open) atomicAdd(number_open, 1);
            }
            if (open) return;  // the others follow
        }
        __syncwarp();
#endif
        #pragma unroll
        for (int i = 0; i < P; ++i) {
            if (!inside[i]) continue;
            const int p = (y + i * STEP) * width + x;
            if (COLOR) {
                const float through = T[i] < 0.0f ? -T[i] : T[i];
                const float* back = background_ + p * background_stride;
                for (int j = 0; j < 3; ++j) color_[3 * p + j] = sums[i][j] + through * back[j];
                alpha_[p] = 1.0f - through;
                depth_[p] = sums[i][3];
            } else {
                for (int j = 0; j < 4 && channel + j < channels; ++j)
                    feature_image_[p * channels + channel + j] = sums[i][j];
            }
        }
"""

# S: what the splats not yet passed still add, the sum of w (channels . v + net_v_alpha); see
# `cpu.backward_source`.
# A splat that hits nothing, and one behind pixels that have stopped, have no partial: `written`
# says which do. (Zeros by the warps, scattered as they lie, took three quarters of the pass where
# much is hidden; zeros everywhere before it, as long as half of it.) On a CPU all are zero before.
_BACKWARD = r"""
        float S[P], net_v_alpha[P], v[P][4];
        #pragma unroll
        for (int i = 0; i < P; ++i) {
            S[i] = net_v_alpha[i] = 0.0f;
            for (int j = 0; j < 4; ++j) v[i][j] = 0.0f;
            if (!inside[i]) continue;
            const int p = (y + i * STEP) * width + x;
            if (COLOR) {
                const float* back = background_ + p * background_stride;
                net_v_alpha[i] = v_alpha_[p];
                v[i][3] = v_depth_[p];
                S[i] = depth_[p] * v[i][3] + alpha_[p] * net_v_alpha[i];
                for (int j = 0; j < 3; ++j) {
                    v[i][j] = v_color_[3 * p + j];
                    S[i] += (color_[3 * p + j] - back[j]) * v[i][j];
                    net_v_alpha[i] -= back[j] * v[i][j];
                }
                for (int c = 0; ABSOLUTE && c < channels; ++c)
                    S[i] += feature_image_[p * channels + c] * v_feature_image_[p * channels + c];
            } else {
                for (int j = 0; j < 4 && channel + j < channels; ++j) {
                    v[i][j] = v_feature_image_[p * channels + channel + j];
                    S[i] += feature_image_[p * channels + channel + j] * v[i][j];
                }
            }
        }
        %(EACH)s
                float sums[10] = {};  // six moments, four channels
                float absolutes[2] = {};
                #pragma unroll
                for (int i = 0; i < P; ++i) {
                    if (!on[i]) continue;
                    const float raw = exp2_of(exponent[i]);
                    const float opaque = raw < max_alpha ? raw : max_alpha;
                    const float before = T[i];
                    const float weight = before * opaque, next = before - weight;
                    if (next > min_transmittance) {
                        float value = net_v_alpha[i];
                        for (int j = 0; j < 4; ++j) {
                            value += f[j] * v[i][j];
                            sums[6 + j] += weight * v[i][j];
                        }
                        if (ABSOLUTE && COLOR) {
                            const int p = (y + i * STEP) * width + x;
                            for (int c = 0; c < channels; ++c)
                                value += features_[row * channels + c]
                                    * v_feature_image_[p * channels + c];
                        }
                        T[i] = next;
                        if (ABSOLUTE && !COLOR) continue;  // the first pass had these moments
                        S[i] -= weight * value;
                        const float clear = 1.0f - opaque > 1e-7f ? 1.0f - opaque : 1e-7f;
                        const float slope = opaque * (before * value - quotient(S[i], clear));
                        const float g = raw <= max_alpha ? slope : 0.0f;
                        const float dy = dy0 + (float)(i * STEP), gu = g * u[i], gy = g * dy;
                        sums[0] += g;
                        sums[1] += gu;
                        sums[2] += gy;
                        sums[3] += gu * u[i];
                        sums[4] += gu * dy;
                        sums[5] += gy * dy;
                        if (ABSOLUTE) {
                            const float along = gu * a, across = gy * c - along * shear;
                            absolutes[0] += along < 0.0f ? -along : along;
                            absolutes[1] += across < 0.0f ? -across : across;
                        }
                    } else {
                        T[i] = -T[i];
                    }
                }
                float* out = partials_ + (long long)partial * stride;
#if defined(__CUDA_ARCH__)
                // 10 sums over 32 lanes: 5, 3, 2, 1 remain to a lane, then the last two lanes add
                const bool in5 = lane & 16, in3 = lane & 8, in2 = lane & 4, in1 = lane & 2;
                #pragma unroll
                for (int j = 0; j < 5; ++j) {
                    const float given = in5 ? sums[j] : sums[j + 5];
                    const float kept = in5 ? sums[j + 5] : sums[j];
                    sums[j] = kept + __shfl_xor_sync(ALL, given, 16);
                }
                sums[5] = 0.0f;
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    const float given = in3 ? sums[j] : sums[j + 3];
                    const float kept = in3 ? sums[j + 3] : sums[j];
                    sums[j] = kept + __shfl_xor_sync(ALL, given, 8);
                }
                sums[3] = 0.0f;
                #pragma unroll
                for (int j = 0; j < 2; ++j) {
                    const float given = in2 ? sums[j] : sums[j + 2];
                    const float kept = in2 ? sums[j + 2] : sums[j];
                    sums[j] = kept + __shfl_xor_sync(ALL, given, 4);
                }
                const float given = in1 ? sums[0] : sums[1], kept = in1 ? sums[1] : sums[0];
                float total = kept + __shfl_xor_sync(ALL, given, 2);
                total += __shfl_xor_sync(ALL, total, 1);
                if (sum_of_lane >= 0 && (COLOR || sum_of_lane < 6
                                         || channel + sum_of_lane - 6 < channels)) {
                    float* to = out + sum_of_lane;
                    if (!COLOR && sum_of_lane >= 6) to += 4 + channel;
                    if (shared_list) atomicAdd(to, total);
                    else if (!COLOR && sum_of_lane < 6) *to += total;
                    else *to = total;
                }
                if (COLOR && lane == 0) ((unsigned char*)written.data)[partial] = 1;
                if (ABSOLUTE && COLOR) {  // both over 32 lanes: lanes 0 and 16 hold one each
                    const float away = in5 ? absolutes[0] : absolutes[1];
                    float own = in5 ? absolutes[1] : absolutes[0];
                    own += __shfl_xor_sync(ALL, away, 16);
                    #pragma unroll
                    for (int apart = 8; apart > 0; apart /= 2)
                        own += __shfl_xor_sync(ALL, own, apart);
                    own *= TWO_LN2;
                    float* to = out + 10 + channels + (in5 ? 1 : 0);
                    if ((lane & 15) == 0) {
                        if (shared_list) atomicAdd(to, own);
                        else *to = own;
                    }
                }
#else
                for (int j = 0; j < 10; ++j) {
                    if (j < 6 || COLOR) out[j] += sums[j];
                    else if (channel + j - 6 < channels) out[10 + channel + j - 6] += sums[j];
                }
                for (int j = 0; ABSOLUTE && COLOR && j < 2; ++j)
                    out[10 + channels + j] += TWO_LN2 * absolutes[j];
#endif
        DONE
        #undef DONE
"""

# Which sum a lane holds after the halving, -1 for none: lanes in pairs, and some hold padding.
_UPSTREAM = r"""
    const float* v_color_ = (const float*)v_color.data;
    const float* v_alpha_ = (const float*)v_alpha.data;
    const float* v_depth_ = (const float*)v_depth.data;
    const float* v_feature_image_ = (const float*)v_feature_image.data;
    float* partials_ = (float*)partials.data;
    const int stride = 10 + channels + (ABSOLUTE ? 2 : 0);
    constexpr float TWO_LN2 = 1.38629436f;
    (void)TWO_LN2;
#if defined(__CUDA_ARCH__)
    const int within = (thread & 4 ? 2 : 0) + (thread & 2 ? 1 : 0);  // of the three or two below
    const int sum_of_lane = (thread & 1) || within >= (thread & 8 ? 2 : 3)
        ? -1 : (thread & 16 ? 5 : 0) + (thread & 8 ? 3 : 0) + within;
#endif
"""

_SIZES = {
    "PIXELS": PIXELS,
    "TILE_WIDTH": TILE_WIDTH,
    "TILE_HEIGHT": TILE_HEIGHT,
    "WARPS": WARPS,
    "STATE": STATE,
}


def _filled(body: str, start: str, color: str) -> str:
    """Colours and depth, read on as `color` says, then four feature channels at a time."""
    first, further = (
        _STATE + body % {"EACH": _EACH % (_SIZES | {"STRETCH": stretch})}
        for stretch in (color, _SORTED)
    )
    return f"""{_HEAD % _SIZES}
#if defined(__CUDA_ARCH__)
    {start}
#endif
    {{
        constexpr bool COLOR = true;
        constexpr int channel = 0;
        (void)channel;
        {first}
    }}
    for (int channel = 0; channel < channels; channel += 4) {{
        constexpr bool COLOR = false;
        {further}
    }}
"""


_SECOND_TIME = r"""
    const bool others = part == 2 && !shared_list;
    if (part == 2 && (shared_list ? !*restarted : !open_[tile])) return;
"""
FORWARD = _filled(_FORWARD, _SECOND_TIME + _CHUNK % _SIZES, _SORTING)
_GRADIENTS = _UPSTREAM + _filled(_BACKWARD, "", _SORTED)
BACKWARD = "constexpr bool ABSOLUTE = false;" + _GRADIENTS
ABSOLUTE = "constexpr bool ABSOLUTE = true;" + _GRADIENTS
