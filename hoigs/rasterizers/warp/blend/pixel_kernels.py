# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Kernels that blend one tile with a warp of 32 lanes, on CUDA and, to test them, on a CPU.

Their C++ stands in `pixel_source`; threads are numbered 32 tile + lane.
"""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.blend import pixel_source
from hoigs.rasterizers.warp.records import F32, I32, I64, U8

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

BLOCK = wp.constant(32 * pixel_source.WARPS)


@wp.func_native(pixel_source.FORWARD)
def forward_native(
    thread: int, tiles: int, tiles_x: int, width: int, height: int, max_alpha: float,
    log2_min_alpha: float, min_transmittance: float, records: F32, indices: I32, offsets: I32,
    features: F32, channels: int, background: F32, background_stride: int, color: F32,
    alpha: F32, depth: F32, feature_image: F32, keys: I64, owners: I32, part: int,
): ...  # fmt: skip


@wp.kernel(launch_bounds=(BLOCK, 5))
def forward_pixels(
    tiles: int, tiles_x: int, width: int, height: int, max_alpha: float, log2_min_alpha: float,
    min_transmittance: float,  # negative: never stop
    records: F32,
    indices: I32,  # [intersections, 2]: Gaussian, partial; on CUDA written, but for a shared list
    offsets: I32,
    features: F32,  # [N, channels]
    channels: int,
    background: F32,  # [3] with stride 0, or [H, W, 3] with stride 3
    background_stride: int, color: F32, alpha: F32, depth: F32,
    feature_image: F32,  # [H, W, channels]
    keys: I64,  # on CUDA, as `intersect.cuda_kernels` have them; indices are sorted on a CPU
    owners: I32,  # likewise
    part: int,  # of the Gaussians, as there
    base: int, count: int,
):  # fmt: skip
    thread = wp.tid() + base
    if thread < count:
        forward_native(
            thread, tiles, tiles_x, width, height, max_alpha, log2_min_alpha, min_transmittance,
            records, indices, offsets, features, channels, background, background_stride, color,
            alpha, depth, feature_image, keys, owners, part,
        )  # fmt: skip


@wp.func_native(pixel_source.BACKWARD)
def backward_native(
    thread: int, tiles: int, tiles_x: int, width: int, height: int, max_alpha: float,
    log2_min_alpha: float, min_transmittance: float, records: F32, indices: I32, offsets: I32,
    features: F32, channels: int, background: F32, background_stride: int, color: F32,
    alpha: F32, depth: F32, feature_image: F32, v_color: F32, v_alpha: F32, v_depth: F32,
    v_feature_image: F32, partials: F32, written: U8,
): ...  # fmt: skip


@wp.kernel(launch_bounds=(BLOCK, 5))
def backward_pixels(
    tiles: int, tiles_x: int, width: int, height: int, max_alpha: float, log2_min_alpha: float,
    min_transmittance: float, records: F32, indices: I32, offsets: I32, features: F32,
    channels: int, background: F32, background_stride: int, color: F32, alpha: F32, depth: F32,
    feature_image: F32, v_color: F32, v_alpha: F32, v_depth: F32, v_feature_image: F32,
    partials: F32,  # [intersections, MOMENTS + channels]; on a CPU zero before
    written: U8,  # on CUDA [intersections], 0 before; becomes 1 where there is a partial
    base: int, count: int,
):  # fmt: skip
    thread = wp.tid() + base
    if thread < count:
        backward_native(
            thread, tiles, tiles_x, width, height, max_alpha, log2_min_alpha, min_transmittance,
            records, indices, offsets, features, channels, background, background_stride, color,
            alpha, depth, feature_image, v_color, v_alpha, v_depth, v_feature_image, partials,
            written,
        )  # fmt: skip
