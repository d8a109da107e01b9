# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The native CPU backward with absolute gradients, compiled only where they are requested."""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.cpu import tile_source
from hoigs.rasterizers.warp.cpu.native_kernels import TILE_WORK
from hoigs.rasterizers.warp.records import F32, I32

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS, "max_unroll": 1})


@wp.func_native(tile_source.ABSOLUTE)
def absolute_native(
    counters: I32, counter: int, tile_height: int, tiles: int, tiles_x: int, width: int,
    height: int, max_alpha: float, log2_min_alpha: float, min_transmittance: float,
    records: F32, indices: I32, offsets: I32, features: F32, channels: int, background: F32,
    background_stride: int, color: F32, alpha: F32, depth: F32, feature_image: F32,
    v_color: F32, v_alpha: F32, v_depth: F32, v_feature_image: F32, partials: F32,
): ...  # fmt: skip


@wp.kernel
def absolute_tiles(
    counters: I32, tile_height: int, tiles: int, tiles_x: int, width: int, height: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float, records: F32, indices: I32,
    offsets: I32, features: F32, channels: int, background: F32, background_stride: int, color: F32,
    alpha: F32, depth: F32, feature_image: F32, v_color: F32, v_alpha: F32, v_depth: F32,
    v_feature_image: F32,
    partials: F32,  # [intersections, MOMENTS + channels + ABSOLUTES], zero
):  # fmt: skip
    absolute_native(
        counters, TILE_WORK, tile_height, tiles, tiles_x, width, height, max_alpha, log2_min_alpha,
        min_transmittance, records, indices, offsets, features, channels, background,
        background_stride, color, alpha, depth, feature_image, v_color, v_alpha, v_depth,
        v_feature_image, partials,
    )  # fmt: skip
