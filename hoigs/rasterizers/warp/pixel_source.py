"""C++ of the pixel kernels: for CUDA, and the same code for a CPU, so that tests can run it.

A warp of 32 lanes draws a tile, TILE_WIDTH pixels wide and TILE_ROWS high; a lane owns PIXELS
pixels of one column. The warp fetches 32 records at a time into shared memory. For the gradient the
sums over the tile are made by halving: each exchange of lanes also halves how many sums a lane
keeps, so ten take 16 shuffles, and lanes write their sums side by side. There are no atomics and no
barriers beyond the warp, and sums have the same order in every run.

On a CPU the lanes run one after the other, and each adds its own share to the partials.
Names of arguments stand in `pixel_kernels`.
"""

from hoigs.rasterizers.warp.tile_spans import TILE_WIDTH

LANES = 32
PIXELS = 4
TILE_ROWS = LANES // TILE_WIDTH * PIXELS
WARPS = 4  # of a block

_HEAD = r"""
    constexpr int P = %(PIXELS)d, STEP = 32 / %(TILE_WIDTH)d;  // rows between a lane's pixels
    const int lane = thread & 31, tile = thread >> 5;
    const int x = tile %% across * %(TILE_WIDTH)d + lane %% %(TILE_WIDTH)d;
    const int y = tile / across * %(TILE_ROWS)d + lane / %(TILE_WIDTH)d;
    const float* records_ = (const float*)records.data;
    const float* features_ = (const float*)features.data;
    const float* background_ = (const float*)background.data;
    const int* pairs_ = (const int*)pairs.data;
    float* color_ = (float*)color.data;
    float* alpha_ = (float*)alpha.data;
    float* depth_ = (float*)depth.data;
    float* extra_ = (float*)extra.data;
    const int begin = ((const int*)offsets.data)[tile], end = ((const int*)offsets.data)[tile + 1];
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[%(WARPS)d * 32 * 4];
    float4* stage = staged + (threadIdx.x >> 5) * 32 * 4;
#endif
    for (int block = 0; block == 0 || 4 * (block - 1) < channels; ++block) {
        const int channel = 4 * (block - 1);  // first feature of this block; block 0 is colour
        float T[P];
        bool inside[P];
        #pragma unroll
        for (int i = 0; i < P; ++i) {
            inside[i] = x < width && y + i * STEP < height;
            T[i] = inside[i] ? 1.0f : -1.0f;  // negative: stopped
        }
"""

# One pair: `continue` leaves it. `raw[i]` is alpha before the clamp where pixel i is hit, else -1.
_PAIR = r"""
        for (int k = begin; k < end; ++k) {
            const int batch = (k - begin) & 31;
            if (batch == 0) {
                bool running = false;
                #pragma unroll
                for (int i = 0; i < P; ++i) running |= T[i] > 0.0f;
#if defined(__CUDA_ARCH__)
                if (!__any_sync(0xffffffffu, running)) break;
                __syncwarp();  // the records before these have been read
                if (k + lane < end) {
                    const long long next = pairs_[2 * (k + lane)];
                    const float4* source = (const float4*)records_ + 4 * next;
                    for (int j = 0; j < 4; ++j) stage[4 * lane + j] = source[j];
                }
                __syncwarp();
#else
                if (!running) break;
#endif
            }
            const int row = pairs_[2 * k];
#if defined(__CUDA_ARCH__)
            const float* g = (const float*)(stage + 4 * batch);
#else
            const float* g = records_ + 16ll * row;
#endif
            const float dx = (float)x + 0.5f - g[0], dy0 = (float)y + 0.5f - g[1];
            const float a = g[2], shear = g[3], c = g[4], log2_opacity = g[5];
            float raw[P], u[P];
            bool hit = false;
            #pragma unroll
            for (int i = 0; i < P; ++i) {
                const float dy = dy0 + (float)(i * STEP);
                u[i] = dx - shear * dy;
                const float exponent = log2_opacity - c * dy * dy - a * u[i] * u[i];
#if defined(__CUDA_ARCH__)
                const float power = exp2f(exponent);
#else
                const float power = wp::exp(exponent * 0.693147180559945309f);
#endif
                raw[i] = exponent >= log2_min_alpha && T[i] > 0.0f ? power : -1.0f;
                hit |= raw[i] >= 0.0f;
            }
#if defined(__CUDA_ARCH__)
            if (!__any_sync(0xffffffffu, hit)) continue;
#else
            if (!hit) continue;
#endif
            float f[4];
            for (int j = 0; j < 4; ++j) {
                if (block == 0) f[j] = g[6 + j];
                else f[j] = channel + j < channels ? features_[row * channels + channel + j] : 0.0f;
            }
"""

_FORWARD = r"""
        float sums[P][4] = {};
        %(PAIR)s
            #pragma unroll
            for (int i = 0; i < P; ++i) {
                if (raw[i] < 0.0f) continue;
                const float weight = T[i] * (raw[i] < max_alpha ? raw[i] : max_alpha);
                const float next = T[i] - weight;
                if (next > min_transmittance) {
                    T[i] = next;
                    for (int j = 0; j < 4; ++j) sums[i][j] += weight * f[j];
                } else {
                    T[i] = -T[i];
                }
            }
        }
        #pragma unroll
        for (int i = 0; i < P; ++i) {
            if (!inside[i]) continue;
            const int p = (y + i * STEP) * width + x;
            if (block == 0) {
                const float left = T[i] < 0.0f ? -T[i] : T[i];
                const float* back = background_ + p * background_stride;
                for (int j = 0; j < 3; ++j) color_[3 * p + j] = sums[i][j] + left * back[j];
                alpha_[p] = 1.0f - left;
                depth_[p] = sums[i][3];
            } else {
                for (int j = 0; j < 4 && channel + j < channels; ++j)
                    extra_[p * channels + channel + j] = sums[i][j];
            }
        }
    }
"""

# S: what the splats not yet passed still add, sum of w (channels . v + veil); see `cpu_source`
_BACKWARD = r"""
        float S[P], veil[P], v[P][4];
        #pragma unroll
        for (int i = 0; i < P; ++i) {
            S[i] = veil[i] = 0.0f;
            for (int j = 0; j < 4; ++j) v[i][j] = 0.0f;
            if (!inside[i]) continue;
            const int p = (y + i * STEP) * width + x;
            if (block == 0) {
                const float* back = background_ + p * background_stride;
                veil[i] = v_alpha_[p];
                v[i][3] = v_depth_[p];
                S[i] = depth_[p] * v[i][3] + alpha_[p] * veil[i];
                for (int j = 0; j < 3; ++j) {
                    v[i][j] = v_color_[3 * p + j];
                    S[i] += (color_[3 * p + j] - back[j]) * v[i][j];
                    veil[i] -= back[j] * v[i][j];
                }
            } else {
                for (int j = 0; j < 4 && channel + j < channels; ++j) {
                    v[i][j] = v_extra_[p * channels + channel + j];
                    S[i] += extra_[p * channels + channel + j] * v[i][j];
                }
            }
        }
        %(PAIR)s
            float sums[16] = {};  // six moments, four channels
            #pragma unroll
            for (int i = 0; i < P; ++i) {
                if (raw[i] < 0.0f) continue;
                const float opaque = raw[i] < max_alpha ? raw[i] : max_alpha;
                const float weight = T[i] * opaque, next = T[i] - weight;
                if (next > min_transmittance) {
                    float value = veil[i];
                    for (int j = 0; j < 4; ++j) {
                        value += f[j] * v[i][j];
                        sums[6 + j] += weight * v[i][j];
                    }
                    S[i] -= weight * value;
                    const float clear = 1.0f - opaque > 1e-7f ? 1.0f - opaque : 1e-7f;
                    const float slope = opaque * (T[i] * value - S[i] / clear);
                    if (raw[i] <= max_alpha) {
                        const float dy = dy0 + (float)(i * STEP);
                        sums[0] += slope;
                        sums[1] += slope * u[i];
                        sums[2] += slope * dy;
                        sums[3] += slope * u[i] * u[i];
                        sums[4] += slope * u[i] * dy;
                        sums[5] += slope * dy * dy;
                    }
                    T[i] = next;
                } else {
                    T[i] = -T[i];
                }
            }
            float* out = partials_ + (long long)pairs_[2 * k + 1] * (10 + channels);
#if defined(__CUDA_ARCH__)
            #pragma unroll
            for (int step = 0; step < 4; ++step) {
                const int half = 8 >> step;
                const bool upper = lane & (2 * half);
                #pragma unroll
                for (int j = 0; j < 8; ++j) {
                    if (j >= half) continue;
                    const float given = upper ? sums[j] : sums[j + half];
                    const float kept = upper ? sums[j + half] : sums[j];
                    sums[j] = kept + __shfl_xor_sync(0xffffffffu, given, 2 * half);
                }
            }
            const float total = sums[0] + __shfl_xor_sync(0xffffffffu, sums[0], 1);
            const int j = lane >> 1;  // the sum that this lane and its neighbour hold
            if ((lane & 1) == 0 && j < 10) {
                if (block == 0) out[j] = total;
                else if (j < 6) out[j] += total;
                else if (channel + j - 6 < channels) out[10 + channel + j - 6] = total;
            }
#else
            for (int j = 0; j < 10; ++j) {
                if (j < 6 || block == 0) out[j] += sums[j];
                else if (channel + j - 6 < channels) out[10 + channel + j - 6] += sums[j];
            }
#endif
        }
    }
"""

_UPSTREAM = r"""
    const float* v_color_ = (const float*)v_color.data;
    const float* v_alpha_ = (const float*)v_alpha.data;
    const float* v_depth_ = (const float*)v_depth.data;
    const float* v_extra_ = (const float*)v_extra.data;
    float* partials_ = (float*)partials.data;
"""

_SIZES = {
    "PIXELS": PIXELS,
    "TILE_WIDTH": TILE_WIDTH,
    "TILE_ROWS": TILE_ROWS,
    "WARPS": WARPS,
}
FORWARD = _HEAD % _SIZES + _FORWARD % {"PAIR": _PAIR}
BACKWARD = _UPSTREAM + _HEAD % _SIZES + _BACKWARD % {"PAIR": _PAIR}
