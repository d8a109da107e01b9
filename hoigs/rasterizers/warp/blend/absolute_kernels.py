# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The pixel kernels' backward with absolute gradients, compiled only where they are requested.

Their C++ is that of `pixel_kernels`, with ABSOLUTE true.
"""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.blend import pixel_source
from hoigs.rasterizers.warp.blend.pixel_kernels import BLOCK
from hoigs.rasterizers.warp.records import F32, I32, U8

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


@wp.func_native(pixel_source.ABSOLUTE)
def absolute_native(
    thread: int, tiles: int, tiles_x: int, width: int, height: int, max_alpha: float,
    log2_min_alpha: float, min_transmittance: float, records: F32, indices: I32, offsets: I32,
    features: F32, channels: int, background: F32, background_stride: int, color: F32,
    alpha: F32, depth: F32, feature_image: F32, v_color: F32, v_alpha: F32, v_depth: F32,
    v_feature_image: F32, partials: F32, written: U8,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def absolute_pixels(
    tiles: int, tiles_x: int, width: int, height: int, max_alpha: float, log2_min_alpha: float,
    min_transmittance: float, records: F32, indices: I32, offsets: I32, features: F32,
    channels: int, background: F32, background_stride: int, color: F32, alpha: F32, depth: F32,
    feature_image: F32, v_color: F32, v_alpha: F32, v_depth: F32, v_feature_image: F32,
    partials: F32,  # [intersections, MOMENTS + channels + ABSOLUTES]; on a CPU zero before
    written: U8,  # on CUDA [intersections], 0 before; becomes 1 where there is a partial
    base: int, count: int,
):  # fmt: skip
    thread = wp.tid() + base
    if thread < count:
        absolute_native(
            thread, tiles, tiles_x, width, height, max_alpha, log2_min_alpha, min_transmittance,
            records, indices, offsets, features, channels, background, background_stride, color,
            alpha, depth, feature_image, v_color, v_alpha, v_depth, v_feature_image, partials,
            written,
        )  # fmt: skip
