# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""CUDA kernels that find tile intersections; `warp.cuda.intersections` launches them.

Their C++ stands in `cuda_source`.
"""

from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.intersect import cuda_source
from hoigs.rasterizers.warp.intersect.tile_spans import TILE_WIDTH
from hoigs.rasterizers.warp.records import F32, I32, I64

wp.set_module_options({"enable_backward": False})

_SIZES = {
    "WIDTH": TILE_WIDTH,
    "BLOCK": cuda_source.BLOCK,
    "PLAN_BLOCK": cuda_source.PLAN_BLOCK,
}


# Parts of a render's Gaussians, each counted, planned, placed and drawn before the next.
ALL = 0
NEAR = 1  # the nearest sixth, of many Gaussians
OTHERS = 2  # behind those, in tiles that they leave open


@wp.func_native(cuda_source.COUNT % _SIZES)
def count_native(
    row: int, part: int, records: F32, drawn_depths: F32, count: int, tile_height: int,
    tiles_x: int, tiles_y: int, width: int, counts: I32, first_partial: I32,
    tiles_per_gaussian: I32, sums: I32, offsets: I32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=cuda_source.BLOCK)
def count_intersections(
    part: int,
    records: F32,
    drawn_depths: F32,  # [N], negative where nothing is drawn
    count: int,  # N; the launch is rounded up to whole blocks
    tile_height: int,  # pixels of a tile's height
    tiles_x: int,
    tiles_y: int,
    width: int,
    counts: I32,  # [tiles], zero
    first_partial: I32,  # [N] partials of the Gaussians before it in its block
    tiles_per_gaussian: I32,  # [N]
    sums: I32,  # [blocks] partials of each block
    offsets: I32,
):
    count_native(
        wp.tid(), part, records, drawn_depths, count, tile_height, tiles_x, tiles_y, width, counts,
        first_partial, tiles_per_gaussian, sums, offsets,
    )  # fmt: skip


@wp.func_native(cuda_source.PLAN % _SIZES)
def plan_native(
    part: int, drawn_depths: F32, count: int, tiles: int, capacity: int, measuring: int,
    counts: I32, sums: I32, offsets: I32, keys: I64, indices: I32, largest: I64,
    largest_on_host: I64,
): ...  # fmt: skip


@wp.kernel(launch_bounds=cuda_source.PLAN_BLOCK)
def plan_intersections(
    part: int,
    drawn_depths: F32,
    count: int,
    tiles: int,
    capacity: int,  # partials that fit, and so intersections; at least N
    measuring: int,  # 1: count only; 0: where they do not fit, make one shared list
    counts: I32,
    sums: I32,  # becomes the number of partials before each block
    # [6 tiles + 7]: the first intersection of each tile, and how many there are; the length of the
    # shared list, or -1; the tiles, longest lists first; up to which intersection each tile's are
    # sorted; of OTHERS, the first of each tile and how many, up to which they are sorted, and the
    # tiles that NEAR leaves open, as 1; how many those are; whether OTHERS led to a shared list;
    # bits of the depth that parts NEAR from OTHERS; how many partials there are
    offsets: I32,
    keys: I64,
    indices: I32,
    largest: I64,  # [1] the largest number of partials so far
    largest_on_host: I64,  # [1] the same, in pinned host memory
):
    plan_native(
        part, drawn_depths, count, tiles, capacity, measuring, counts, sums, offsets, keys, indices,
        largest, largest_on_host,
    )  # fmt: skip


@wp.func_native(cuda_source.PLACE % _SIZES)
def place_native(
    row: int, part: int, records: F32, drawn_depths: F32, count: int, tile_height: int,
    tiles_x: int, tiles_y: int, width: int, counts: I32, first_partial: I32,
    tiles_per_gaussian: I32, sums: I32, offsets: I32, keys: I64, owners: I32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=cuda_source.BLOCK)
def place_intersections(
    part: int, records: F32, drawn_depths: F32, count: int, tile_height: int, tiles_x: int,
    tiles_y: int, width: int,
    counts: I32,  # becomes zero
    first_partial: I32,  # becomes the index in `partials` of each Gaussian's first
    tiles_per_gaussian: I32, sums: I32, offsets: I32,
    keys: I64,  # bits of the depth in the high half, partial in the low
    owners: I32,  # the Gaussian of each partial
):  # fmt: skip
    place_native(
        wp.tid(), part, records, drawn_depths, count, tile_height, tiles_x, tiles_y, width, counts,
        first_partial, tiles_per_gaussian, sums, offsets, keys, owners,
    )  # fmt: skip
