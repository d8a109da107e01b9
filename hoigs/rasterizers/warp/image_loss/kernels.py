# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The CUDA kernels of the image loss; their loops stand in `source`.

Threads are numbered as in `warp.ssim.tile_kernels`. One image of three channels: batch is 1.
"""

from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp
from hoigs.rasterizers.warp.common.records import F32, U8
from hoigs.rasterizers.warp.image_loss import source
from hoigs.rasterizers.warp.ssim.tile_source import THREADS

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

BLOCK = wp.constant(THREADS)


@wp.func_native(source.FORWARD)
def forward_native(
    thread: int, batch: int, height: int, width: int, channels: int,
    render: F32, render_stride: int, pixels: U8, pixel_stride: int, shown: U8, ignored: U8,
    mask_stride: int, with_shown: int, with_ignored: int, background: F32, l1_weight: float,
    dssim_weight: float, with_gradient: int, sums: F32, kept: F32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def forward_tiles(
    height: int, width: int,
    render: F32, render_stride: int,  # floats from line to line
    pixels: U8, pixel_stride: int,  # of the frame, bytes
    shown: U8,  # 0 where the target is the background; not read unless with_shown
    ignored: U8, mask_stride: int, with_shown: int, with_ignored: int,
    background: F32,  # [3]
    l1_weight: float, dssim_weight: float, with_gradient: int,
    sums: F32,  # [tiles] of the weighted loss
    kept: F32,  # [3, 3, height, width], or empty: to blur
):  # fmt: skip
    forward_native(
        wp.tid(), 1, height, width, 3, render, render_stride, pixels, pixel_stride, shown, ignored,
        mask_stride, with_shown, with_ignored, background, l1_weight, dssim_weight, with_gradient,
        sums, kept,
    )  # fmt: skip


@wp.func_native(source.BACKWARD)
def backward_native(
    thread: int, batch: int, height: int, width: int, channels: int,
    render: F32, render_stride: int, pixels: U8, pixel_stride: int, shown: U8, ignored: U8,
    mask_stride: int, with_shown: int, with_ignored: int, background: F32, l1_weight: float,
    dssim_weight: float, kept: F32, upstream: F32, gradient: F32, gradient_stride: int, add: int,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def backward_tiles(
    height: int, width: int,
    render: F32, render_stride: int, pixels: U8, pixel_stride: int, shown: U8, ignored: U8,
    mask_stride: int, with_shown: int, with_ignored: int, background: F32,
    l1_weight: float, dssim_weight: float, kept: F32,
    upstream: F32,  # [1]
    gradient: F32, gradient_stride: int,
    add: int,  # 0 writes the gradient, 1 adds to what stands there
):  # fmt: skip
    backward_native(
        wp.tid(), 1, height, width, 3, render, render_stride, pixels, pixel_stride, shown, ignored,
        mask_stride, with_shown, with_ignored, background, l1_weight, dssim_weight, kept, upstream,
        gradient, gradient_stride, add,
    )  # fmt: skip
