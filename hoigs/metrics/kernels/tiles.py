# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""SSIM on CUDA: one block of threads for a tile of one channel. It runs on a CPU too, for tests."""

from typing import Any

import torch
from torch import Tensor

from hoigs.core.fast.cuda_launch import CudaStreams
from hoigs.core.fast.launch import CPU_FLAGS, prepared
from hoigs.core.system.quiet_warp import wp
from hoigs.metrics.kernels.definition import FORMULA, WEIGHTS
from hoigs.rasterizers.warp.records import F32

# C++ of the CUDA kernels of SSIM, and the same code for a CPU, so that tests can run it.
#
# A block of THREADS threads makes one tile of SIDE x SIDE pixels of one channel. Stages in shared
# memory, each a loop that the threads share out: fetch the tile with 5 more pixels around it, blur
# along its lines, blur across them; four pixels of a column to a thread, so that each line is read
# once for four. `forward` keeps the three images of `definition.FORMULA`, `backward` blurs them
# into the gradient (as fused-ssim does; Mallick et al. 2024, Taming 3DGS). There are no atomics:
# sums have the same order in every run.
#
# On a CPU one thread does the work of a block. The arguments are described in `tile_kernels`. The
# image loss of `warp.image_loss` has the same stages, and other pieces where FETCH, PIXEL and
# GRADIENT stand.

SIDE = 32
THREADS = 256
_HEAD = r"""
#if defined(__CUDA_ARCH__)
    #define HOIGS_SHARED __shared__
    #define HOIGS_SYNC __syncthreads()
    constexpr int STEP = %(THREADS)d;
    const int block = thread / STEP, me = thread %% STEP;
#else
    #define HOIGS_SHARED
    #define HOIGS_SYNC
    constexpr int STEP = 1;
    const int block = thread, me = 0;
#endif
    constexpr int SIDE = %(SIDE)d, WIDE = SIDE + 10, R = 4;
    const float w[6] = %(WEIGHTS)s;
    const int tiles_x = (width + SIDE - 1) / SIDE, tiles_y = (height + SIDE - 1) / SIDE;
    // channel by channel, so that neighbours in time read the same lines of memory
    const int channel = block %% channels, tile = block / channels;
    const int X = tile %% tiles_x * SIDE, Y = tile / tiles_x %% tiles_y * SIDE;
    const int picture = tile / tiles_x / tiles_y;
    const long long first = (long long)picture * height * width;
    const long long plane = first * channels + (long long)channel * height * width;
    float* kept_ = (float*)kept.data;
    const long long numbers = (long long)batch * height * width * channels;  // from kept to kept
"""
_FORWARD = r"""
    HOIGS_SHARED float in[2][WIDE][WIDE];
    HOIGS_SHARED float lines[4][WIDE][SIDE];
    HOIGS_SHARED float totals[STEP];
    for (int i = me; i < WIDE * WIDE; i += STEP) {
        const int r = i / WIDE, c = i % WIDE, y = Y + r - 5, x = X + c - 5;
        float a = 0.0f, b = 0.0f;
        if (y >= 0 && y < height && x >= 0 && x < width) { FETCH }
        in[0][r][c] = a + b;
        in[1][r][c] = a - b;
    }
    HOIGS_SYNC;
    for (int i = me; i < WIDE * SIDE; i += STEP) {
        const int r = i / SIDE, c = i % SIDE;
        #pragma unroll
        for (int n = 0; n < 2; ++n) {
            const float* at = in[n][r] + c + 5;
            float mean = w[5] * at[0], square = mean * at[0];
            #pragma unroll
            for (int k = 0; k < 5; ++k) {
                const float a = at[k - 5], b = at[5 - k];
                mean += w[k] * (a + b);
                square += w[k] * (a * a + b * b);
            }
            lines[n][r][c] = mean;
            lines[2 + n][r][c] = square;
        }
    }
    HOIGS_SYNC;
    double sum = 0.0;  // on a CPU of all the tile
    for (int i = me; i < SIDE * SIDE / R; i += STEP) {
        const int c = i % SIDE, top = i / SIDE * R;
        float m[4][R] = {};
        #pragma unroll
        for (int n = 0; n < 4; ++n)
            #pragma unroll
            for (int k = 0; k < R + 10; ++k) {
                const float value = lines[n][top + k][c];
                #pragma unroll
                for (int j = 0; j < R; ++j) {
                    const int tap = k - j;
                    if (tap >= 0 && tap <= 10) m[n][j] += w[tap < 6 ? tap : 10 - tap] * value;
                }
            }
        #pragma unroll
        for (int j = 0; j < R; ++j) {
            const int y = Y + top + j, x = X + c;
            if (y >= height || x >= width) continue;
            float by_mean, by_sum, by_difference;
            const float value = similarity(
                m[0][j], m[1][j], m[2][j], m[3][j], by_mean, by_sum, by_difference);
            const long long pixel = (long long)y * width + x;
            { PIXEL }
            if (!with_gradient) continue;
            kept_[plane + pixel] = by_mean;
            kept_[plane + pixel + numbers] = by_sum;
            kept_[plane + pixel + 2 * numbers] = by_difference;
        }
    }
    totals[me] = (float)sum;
    HOIGS_SYNC;
    for (int half = STEP / 2; half > 0; half /= 2) {
        if (me < half) totals[me] += totals[me + half];
        HOIGS_SYNC;
    }
    if (me == 0) ((float*)sums.data)[block] = totals[0];
"""
_BACKWARD = r"""
    HOIGS_SHARED float in[3][WIDE][WIDE];
    HOIGS_SHARED float lines[3][WIDE][SIDE];
    for (int i = me; i < WIDE * WIDE; i += STEP) {
        const int r = i / WIDE, c = i % WIDE, y = Y + r - 5, x = X + c - 5;
        const bool inside = y >= 0 && y < height && x >= 0 && x < width;
        const long long at = plane + (long long)y * width + x;
        #pragma unroll
        for (int n = 0; n < 3; ++n) in[n][r][c] = inside ? kept_[at + n * numbers] : 0.0f;
    }
    HOIGS_SYNC;
    for (int i = me; i < WIDE * SIDE; i += STEP) {
        const int r = i / SIDE, c = i % SIDE;
        #pragma unroll
        for (int n = 0; n < 3; ++n) {
            const float* at = in[n][r] + c + 5;
            float value = w[5] * at[0];
            #pragma unroll
            for (int k = 0; k < 5; ++k) value += w[k] * (at[k - 5] + at[5 - k]);
            lines[n][r][c] = value;
        }
    }
    HOIGS_SYNC;
    const float scale = ((const float*)upstream.data)[0];
    for (int i = me; i < SIDE * SIDE / R; i += STEP) {
        const int c = i % SIDE, top = i / SIDE * R;
        float g[3][R] = {};
        #pragma unroll
        for (int n = 0; n < 3; ++n)
            #pragma unroll
            for (int k = 0; k < R + 10; ++k) {
                const float value = lines[n][top + k][c];
                #pragma unroll
                for (int j = 0; j < R; ++j) {
                    const int tap = k - j;
                    if (tap >= 0 && tap <= 10) g[n][j] += w[tap < 6 ? tap : 10 - tap] * value;
                }
            }
        #pragma unroll
        for (int j = 0; j < R; ++j) {
            const int y = Y + top + j, x = X + c;
            if (y >= height || x >= width) continue;
            float a = 0.0f, b = 0.0f;
            FETCH
            const float slope = g[0][j] + (a + b) * g[1][j] + (a - b) * g[2][j];
            GRADIENT
        }
    }
"""
_TAIL = r"""
    HOIGS_SYNC;  // before the next tile of this block overwrites shared memory
    #undef HOIGS_SHARED
    #undef HOIGS_SYNC
"""
_SIZES = {"SIDE": SIDE, "THREADS": THREADS, "WEIGHTS": WEIGHTS}


def forward(fetch: str, pixel: str, first: str = "", then: str = "") -> str:
    """Body of a forward kernel.

    Args:
        fetch: sets `a`, of the image, and `b`, of the target, at (x, y) of `channel`.
        pixel: adds to `sum` of the tile, from `value`, the pixel's SSIM.
        first: may change the arguments before anything reads them. then: may return, for all
            threads of a tile alike.
    """
    body = _FORWARD.replace("FETCH", fetch).replace("PIXEL", pixel)
    return first + _HEAD % _SIZES + then + FORMULA + body + _TAIL


def backward(fetch: str, gradient: str, first: str = "", then: str = "") -> str:
    """Body of a backward kernel.

    Args:
        fetch: as in `forward`.
        gradient: writes a gradient at (x, y), from `slope`, the derivative of the sum of SSIM over
            all pixels by `a`, and `scale`, the upstream gradient. It sees the variables of `fetch`.
        first, then: as in `forward`.
    """
    body = _BACKWARD.replace("FETCH", fetch).replace("GRADIENT", gradient)
    return first + _HEAD % _SIZES + then + body + _TAIL


_FETCH = """
            const long long at = (first + (long long)y * width + x) * channels + channel;
            a = ((const float*)image.data)[at];
            b = ((const float*)target.data)[at];
"""
_PIXEL = """
            sum += value;
            if (with_map) ((float*)map.data)[(first + pixel) * channels + channel] = value;
"""
_GRADIENT = "((float*)gradient.data)[at] = scale / (float)numbers * slope;"
FORWARD = forward(_FETCH, _PIXEL)
BACKWARD = backward(_FETCH, _GRADIENT)


# The CUDA kernels of SSIM; their loops stand in `tile_source`.
#
# Threads are numbered THREADS tile + place on CUDA; on a CPU there is one for a tile.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
BLOCK = wp.constant(THREADS)


@wp.func_native(FORWARD)
def forward_native(
    thread: int, batch: int, height: int, width: int, channels: int, image: F32, target: F32,
    with_map: int, with_gradient: int, sums: F32, map: F32, kept: F32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def forward_tiles(
    batch: int, height: int, width: int, channels: int,
    image: F32,  # [batch, height, width, channels]
    target: F32, with_map: int, with_gradient: int,
    sums: F32,  # [tiles] of SSIM
    map: F32,  # [batch, height, width, channels], or empty
    kept: F32,  # [3, batch, channels, height, width], or empty: to blur
):  # fmt: skip
    forward_native(
        wp.tid(), batch, height, width, channels, image, target, with_map, with_gradient, sums,
        map, kept,
    )  # fmt: skip


@wp.func_native(BACKWARD)
def backward_native(
    thread: int, batch: int, height: int, width: int, channels: int, image: F32, target: F32,
    kept: F32, upstream: F32, gradient: F32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def backward_tiles(
    batch: int, height: int, width: int, channels: int, image: F32, target: F32, kept: F32,
    upstream: F32,  # [1] gradient of the mean
    gradient: F32,  # [batch, height, width, channels]
):  # fmt: skip
    backward_native(
        wp.tid(), batch, height, width, channels, image, target, kept, upstream, gradient
    )


class TileKernels:
    """Two kernels, on torch's current stream; nothing waits for the device."""

    max_channels: int | None = None

    def __init__(self) -> None:
        self._streams = CudaStreams()

    def mean(
        self, image: Tensor, target: Tensor, with_gradient: bool
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        kept = image.new_empty(3 * image.numel() if with_gradient else 0)
        sums = self._forward(image, target, image.new_empty(0), kept)
        value = (sums.sum(dtype=torch.float64) / image.numel()).float()
        return value, (image, target, kept)

    def gradient(self, kept: tuple[Tensor, ...], upstream: Tensor) -> Tensor:
        image, target, planes = kept
        result = torch.empty_like(image)
        self._launch(backward_tiles, image, [image, target, planes, upstream, result])
        return result

    def map(self, image: Tensor, target: Tensor) -> Tensor:
        result = torch.empty_like(image)
        self._forward(image, target, result, image.new_empty(0))
        return result

    def _forward(self, image: Tensor, target: Tensor, result: Tensor, kept: Tensor) -> Tensor:
        sums = image.new_empty(_tiles(image))
        flags = [int(result.numel() > 0), int(kept.numel() > 0)]
        self._launch(forward_tiles, image, [image, target, *flags, sums, result, kept])
        return sums

    def _launch(self, kernel: Any, image: Tensor, arguments: list[Any]) -> None:
        arguments = [*image.shape, *arguments]
        if image.is_cuda:
            self._streams.current().blocks(kernel, _tiles(image), THREADS, arguments)
        else:
            prepared(kernel, _tiles(image), arguments).launch()


def _tiles(image: Tensor) -> int:
    batch, height, width, channels = image.shape
    return batch * channels * -(-height // SIDE) * -(-width // SIDE)
