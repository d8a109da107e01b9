# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The CUDA kernels of SSIM; their loops stand in `tile_source`.

Threads are numbered THREADS tile + place on CUDA; on a CPU there is one for a tile.
"""

from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp
from hoigs.rasterizers.warp.common.records import F32
from hoigs.rasterizers.warp.ssim import tile_source

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

BLOCK = wp.constant(tile_source.THREADS)


@wp.func_native(tile_source.FORWARD)
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


@wp.func_native(tile_source.BACKWARD)
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
