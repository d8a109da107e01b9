# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The CPU kernel of SSIM; its loops stand in `strip_source`."""

from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp
from hoigs.rasterizers.warp.common.records import F32, I32
from hoigs.rasterizers.warp.ssim import strip_source

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


@wp.func_native(strip_source.SOURCE)
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
