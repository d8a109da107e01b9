# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""SSIM on CPUs: the kernel of `strip_source` on all cores."""

import torch
from torch import Tensor

from hoigs.core.fast.launch import CPU_FLAGS, SerialWorkers, ThreadWorkers, prepared
from hoigs.core.system.quiet_warp import wp
from hoigs.metrics.kernels.definition import FORMULA, WEIGHTS
from hoigs.rasterizers.warp.records import F32, I32

# C++ of the CPU kernel: SSIM and its gradient in one pass down a strip of the image.
#
# An image [H, W, C] is taken as H lines of W C floats, so that a neighbour of a pixel lies C floats
# away and nothing need be sorted by channel. A strip is at most STRIP floats wide; a band of it is
# one work item. Line after line, R at a time,
#
# 1. p and d of a line of the images are blurred along it, and kept in a ring of 16 lines (`means`);
# 2. the ring blurred down gives SSIM and the images of `definition.FORMULA` at the line 5 above,
#    which are blurred along the line and kept in a second ring (`slopes`);
# 3. that one blurred down gives the gradient of the line 5 above that (7, to keep lines in step).
#
# So nothing as large as the image is stored but the gradient. Strips see SIDE floats beyond their
# edges at each blur, bands 10 lines: those are computed twice. Every value is made by the same
# operations whatever the bands, so results do not depend on the number of cores.
#
# LLVM vectorises none of this by itself: vectors are written out as in `cpu.vector_source`, and
# casts as (float)(x), since `float(x)` and `int(x)` are macros of Warp. The arguments are described
# in `strip_kernels`.

STRIP = 512
SIDE = 16  # at least 5 channels, and whole vectors
MAX_CHANNELS = SIDE // 5
_TYPES = r"""
#if defined(__AVX512F__)
    constexpr int V = 16;
#else
    constexpr int V = 8;
#endif
    constexpr int R = 4;  // lines in step: with two vectors each, eight sums and the weights fit
    // into 16 registers, and each line of a ring is read once for four
    typedef float vec __attribute__((vector_size(4 * V)));
    typedef float loose __attribute__((vector_size(4 * V), aligned(4)));
    typedef int ivec __attribute__((vector_size(4 * V)));
    constexpr int SIDE = %(SIDE)d, STRIP = %(STRIP)d, LINES = 16;
    constexpr int INNER = STRIP + 3 * SIDE, OUTER = STRIP + 5 * SIDE;
    const float taps[6] = %(WEIGHTS)s;
    volatile float opaque[6];  // read through `volatile`, weights stay in registers
    vec w[6];
    for (int k = 0; k < 6; ++k) opaque[k] = taps[k];
    for (int k = 0; k < 6; ++k) w[k] = (vec){} + opaque[k];
    ivec lane;
    for (int i = 0; i < V; ++i) lane[i] = i;
    // lines of p and of d, from SIDE before the inner line
    alignas(64) float lines[2][OUTER];
    alignas(64) float means[LINES][4][INNER];
    // images to blur; from SIDE before the strip
    alignas(64) float slope[R][3][INNER];
    alignas(64) float slopes[LINES][3][STRIP + SIDE];
    __builtin_memset(slope, 0, sizeof(slope));
    __builtin_memset(slopes, 0, sizeof(slopes));
    __builtin_memset(means, 0, sizeof(means));
    const float* image_ = (const float*)image.data;
    const float* target_ = (const float*)target.data;
    float* sums_ = (float*)sums.data;
    float* map_ = (float*)map.data;
    float* gradient_ = (float*)gradient.data;
    auto fma = [](vec a, vec b, vec c) -> vec {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        return __builtin_elementwise_fma(a, b, c);
#else
        return a * b + c;
#endif
    };
    auto load = [](const float* at) -> vec { return *(const loose*)at; };
    // R lines of a ring from line y on, two vectors at i, blurred across lines
    auto down = [&](auto& ring, int y, int i, auto& out) {
        #pragma clang loop unroll(disable)
        for (int n = 0; n < (int)(sizeof(out) / sizeof(out[0])); ++n) {
            vec sum[R][2];
            #pragma unroll
            for (int j = 0; j < R; ++j) sum[j][0] = sum[j][1] = (vec){};
            #pragma unroll
            for (int k = 0; k < R + 10; ++k) {
                const float* at = ring[(y - 5 + k) & (LINES - 1)][n] + i;
                const vec first = *(const vec*)at, second = *(const vec*)(at + V);
                #pragma unroll
                for (int j = 0; j < R; ++j) {
                    const int tap = k - j;
                    if (tap < 0 || tap > 10) continue;
                    sum[j][0] = fma(w[tap < 6 ? tap : 10 - tap], first, sum[j][0]);
                    sum[j][1] = fma(w[tap < 6 ? tap : 10 - tap], second, sum[j][1]);
                }
            }
            #pragma unroll
            for (int j = 0; j < R; ++j) {
                out[n][j][0] = sum[j][0];
                out[n][j][1] = sum[j][1];
            }
        }
    };
    auto total = [](vec x) -> float {
        float halves[V];
        for (int i = 0; i < V; ++i) halves[i] = x[i];
        for (int half = V / 2; half > 0; half /= 2)
            for (int i = 0; i < half; ++i) halves[i] += halves[i + half];
        return halves[0];
    };
"""
_PIECES = r"""
    const int length = width * channels;
    const bool slopes_too = with_gradient != 0;
    const int reach = slopes_too ? 5 : 0;  // lines and vectors beyond the band that SSIM is for
    for (;;) {
        const int piece = __atomic_fetch_add((int*)counters.data, 1, __ATOMIC_RELAXED);
        if (piece >= batch * bands * strips) break;
        const int strip = piece % strips, band = piece / strips % bands;
        const long long first_line = (long long)(piece / strips / bands) * height;
        const int Y0 = band * band_lines;
        const int Y1 = Y0 + band_lines < height ? Y0 + band_lines : height;
        const int X = strip * strip_width;
        const int wide = length - X < strip_width ? length - X : strip_width;
        const int vectors = (wide + V - 1) / V;
        const int begin = slopes_too ? 0 : SIDE, end = SIDE + vectors * V + (slopes_too ? SIDE : 0);
        auto add_line = [&](int y) {
            auto* mean = means[y & (LINES - 1)];
            if (y < 0 || y >= height) {
                for (int n = 0; n < 4; ++n)
                    for (int i = begin; i < end; i += V) *(vec*)(mean[n] + i) = (vec){};
                return;
            }
            // floats of the line at hand: [from, to) of lines[.]
            const int origin = X - 2 * SIDE, last = end + 2 * SIDE;
            const int from = origin < 0 ? -origin : 0;
            const int to = length - origin < last ? length - origin : last;
            const float* x = image_ + (first_line + y) * length + origin;
            const float* t = target_ + (first_line + y) * length + origin;
            for (int i = 0; i < from; ++i) lines[0][i] = lines[1][i] = 0.0f;
            int i = from;
            for (; i + V <= to; i += V) {
                *(loose*)(lines[0] + i) = load(x + i) + load(t + i);
                *(loose*)(lines[1] + i) = load(x + i) - load(t + i);
            }
            for (; i < to; ++i) {
                lines[0][i] = x[i] + t[i];
                lines[1][i] = x[i] - t[i];
            }
            for (; i < last; ++i) lines[0][i] = lines[1][i] = 0.0f;
            for (i = begin; i < end; i += V) {
                #pragma unroll
                for (int n = 0; n < 2; ++n) {
                    const float* at = lines[n] + SIDE + i;
                    const vec middle = load(at);
                    vec mean_ = w[5] * middle, square = mean_ * middle;
                    #pragma unroll
                    for (int k = 0; k < 5; ++k) {
                        const vec a = load(at + (k - 5) * channels);
                        const vec b = load(at + (5 - k) * channels);
                        mean_ += w[k] * (a + b);
                        square += w[k] * (a * a + b * b);
                    }
                    *(vec*)(mean[n] + i) = mean_;
                    *(vec*)(mean[2 + n] + i) = square;
                }
            }
        };
"""
_DOWN = r"""
        for (int q = Y0 - reach - 5; q < Y0 - reach + 5; ++q) add_line(q);
        for (int q = Y0 - reach; slopes_too ? q - 7 < Y1 : q < Y1; q += R) {
            const int line_end = Y1 + reach;
            for (int j = 0; j < R; ++j)
                if (q + j < line_end) add_line(q + j + 5);
            if (q < line_end) {
                vec sum[R];
                for (int j = 0; j < R; ++j) sum[j] = (vec){};
                for (int i = begin; i < end; i += 2 * V) {
                    vec m[4][R][2];
                    down(means, q, i, m);
                    #pragma clang loop unroll(disable)
                    for (int u = 0; u < 2 * R; ++u) {
                        const int j = u >> 1, at = i + (u & 1) * V, y = q + j;
                        const ivec column = lane + (X - SIDE + at);
                        const ivec inside = (column >= 0) & (column < length);
                        vec a, b, c;
                        vec value = similarity(m[0][j][u & 1], m[1][j][u & 1],
                            m[2][j][u & 1], m[3][j][u & 1], a, b, c);
                        if (at >= SIDE && at < SIDE + vectors * V) {
                            value = (vec)((ivec)value & inside);
                            sum[j] += value;
                            if (with_map && y >= Y0 && y < Y1) {
                                float* out = map_ + (first_line + y) * length + X + at - SIDE;
                                const int left = wide - (at - SIDE);
                                for (int n = 0; n < V && n < left; ++n) out[n] = value[n];
                            }
                        }
                        if (!slopes_too) continue;
                        const ivec drawn = y >= 0 && y < height ? inside : (ivec){};
                        *(vec*)(slope[j][0] + at) = (vec)((ivec)a & drawn);
                        *(vec*)(slope[j][1] + at) = (vec)((ivec)b & drawn);
                        *(vec*)(slope[j][2] + at) = (vec)((ivec)c & drawn);
                    }
                }
                for (int j = 0; j < R; ++j)
                    if (q + j >= Y0 && q + j < Y1)
                        sums_[(first_line + q + j) * strips + strip] = total(sum[j]);
            }
            if (!slopes_too) continue;
"""
_BACK = r"""
            for (int j = 0; j < R; ++j) {
                auto* out = slopes[(q + j) & (LINES - 1)];
                for (int i = 0; i < vectors * V; i += V) {
                    #pragma unroll
                    for (int n = 0; n < 3; ++n) {
                        const float* at = slope[j][n] + SIDE + i;
                        vec value = w[5] * load(at);
                        #pragma unroll
                        for (int k = 0; k < 5; ++k)
                            value += w[k] * (load(at + (k - 5) * channels)
                                + load(at + (5 - k) * channels));
                        *(vec*)(out[n] + i) = value;
                    }
                }
            }
            const int y = q - 7;
            if (y < Y0) continue;
            for (int i = 0; i < vectors * V; i += 2 * V) {
                vec g[3][R][2];
                down(slopes, y, i, g);
                #pragma clang loop unroll(disable)
                for (int u = 0; u < 2 * R; ++u) {
                    const int j = u >> 1, left = wide - (i + (u & 1) * V);
                    if (y + j >= Y1 || left <= 0) continue;
                    const vec f = g[0][j][u & 1], by_sum = g[1][j][u & 1], by_diff = g[2][j][u & 1];
                    const long long at = (first_line + y + j) * length + X + i + (u & 1) * V;
                    if (left >= V) {
                        const vec x = load(image_ + at), t = load(target_ + at);
                        *(loose*)(gradient_ + at) =
                            scale * (f + (x + t) * by_sum + (x - t) * by_diff);
                        continue;
                    }
                    for (int n = 0; n < left; ++n) {
                        const float x = image_[at + n], t = target_[at + n];
                        gradient_[at + n] =
                            scale * (f[n] + (x + t) * by_sum[n] + (x - t) * by_diff[n]);
                    }
                }
            }
        }
    }
"""
_SIZES = {"SIDE": SIDE, "STRIP": STRIP, "WEIGHTS": WEIGHTS}
SOURCE = _TYPES % _SIZES + FORMULA + _PIECES + _DOWN + _BACK


# The CPU kernel of SSIM; its loops stand in `strip_source`.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


@wp.func_native(SOURCE)
def similarity_native(
    counters: I32, batch: int, height: int, width: int, channels: int, strips: int,
    strip_width: int, bands: int, band_lines: int, image: F32, target: F32, scale: float,
    with_map: int, with_gradient: int, sums: F32, map: F32, gradient: F32,
): ...  # fmt: skip


@wp.kernel
def similarity_strips(
    counters: I32,  # [1], zero: the next work item, for workers that make this same call
    batch: int, height: int, width: int,
    channels: int,  # at most strip_source.MAX_CHANNELS
    strips: int,  # of one line of width * channels floats
    strip_width: int,  # floats, a multiple of 16, at most strip_source.STRIP
    bands: int, band_lines: int,
    image: F32,  # [batch, height, width, channels]
    target: F32,
    scale: float,  # of the gradient
    with_map: int, with_gradient: int,
    sums: F32,  # [batch, height, strips] of SSIM
    map: F32,  # [batch, height, width, channels], or empty
    gradient: F32,  # likewise: of the sum of SSIM to the image, times scale
):  # fmt: skip
    similarity_native(
        counters, batch, height, width, channels, strips, strip_width, bands, band_lines, image,
        target, scale, with_map, with_gradient, sums, map, gradient,
    )  # fmt: skip


WORTHWHILE = 2**15  # an image with so many floats takes as long as waking another core
LEAST_LINES = 64  # of a band: it computes 10 lines beyond each end again


class StripKernels:
    """Value and gradient in one pass; backward only scales the gradient by the upstream one.

    Keeping the three images from which the gradient is blurred, as the CUDA kernels do, would move
    three times as much memory.
    """

    max_channels: int | None = MAX_CHANNELS

    def mean(
        self, image: Tensor, target: Tensor, with_gradient: bool
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        gradient = torch.empty_like(image) if with_gradient else image.new_empty(0)
        sums = _run(image, target, image.new_empty(0), gradient)
        value = (sums.sum(dtype=torch.float64) / image.numel()).float()
        return value, (gradient,)

    def gradient(self, kept: tuple[Tensor, ...], upstream: Tensor) -> Tensor:
        return kept[0] * upstream

    def map(self, image: Tensor, target: Tensor) -> Tensor:
        result = torch.empty_like(image)
        _run(image, target, result, image.new_empty(0))
        return result


def _run(image: Tensor, target: Tensor, result: Tensor, gradient: Tensor) -> Tensor:
    """Fill map and gradient where they are not empty; returns sums of SSIM [B, H, strips]."""
    batch, height, width, channels = image.shape
    length = width * channels
    strips = -(-length // STRIP)
    strip_width = 16 * -(-length // (16 * strips))
    cores = max(1, min(torch.get_num_threads(), image.numel() // WORTHWHILE))
    wanted = 2 * cores if cores > 1 else 1  # work items: cores may be of unequal speed
    bands = max(1, min(-(-wanted // (batch * strips)), height // LEAST_LINES))
    sums = image.new_empty(batch, height, strips)
    arguments = [
        torch.zeros(1, dtype=torch.int32), batch, height, width, channels, strips, strip_width,
        bands, -(-height // bands), image, target, 1.0 / image.numel(), int(result.numel() > 0),
        int(gradient.numel() > 0), sums, result, gradient,
    ]  # fmt: skip
    launches = [prepared(similarity_strips, 1, arguments)] * cores
    (SerialWorkers() if cores == 1 else ThreadWorkers()).run(launches)
    return sums
