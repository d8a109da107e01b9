# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Kernels that list the splats of each tile on CUDA; see `lists`.

Their C++ stands in `list_source` and `order_source`.
"""

from hoigs.rasterizers.warp import list_source, order_source
from hoigs.rasterizers.warp.records import F32, I32, I64
from hoigs.rasterizers.warp.runtime import wp
from hoigs.rasterizers.warp.tile_spans import TILE_WIDTH

wp.set_module_options({"enable_backward": False})

SORT_BLOCK = wp.constant(order_source.SORT_BLOCK)
_SIZES = {
    "WIDTH": TILE_WIDTH,
    "BLOCK": list_source.BLOCK,
    "PLAN_BLOCK": order_source.PLAN_BLOCK,
    "SORT_BLOCK": order_source.SORT_BLOCK,
}


@wp.func_native(list_source.COUNT % _SIZES)
def count_native(
    row: int, records: F32, drawn_depths: F32, count: int, rows: int, across: int, down: int,
    width: int, counts: I32, first: I32, slots: I32, sums: I32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=list_source.BLOCK)
def count_pairs(
    records: F32,
    drawn_depths: F32,  # [N], negative where nothing is drawn
    count: int,  # N; the launch is rounded up to whole blocks
    rows: int,  # pixels of a tile's height
    across: int,
    down: int,
    width: int,
    counts: I32,  # [tiles], zero
    first: I32,  # [N] pairs of the rows before it in its block
    slots: I32,  # [N] pairs of each row
    sums: I32,  # [blocks] pairs of each block
):
    count_native(
        wp.tid(), records, drawn_depths, count, rows, across, down, width, counts, first, slots,
        sums,
    )  # fmt: skip


@wp.func_native(order_source.PLAN % _SIZES)
def plan_native(
    drawn_depths: F32, count: int, tiles: int, capacity: int, measuring: int, counts: I32,
    sums: I32, offsets: I32, keys: I64, pairs: I32, seen: I64, told: I64,
): ...  # fmt: skip


@wp.kernel(launch_bounds=order_source.PLAN_BLOCK)
def plan_lists(
    drawn_depths: F32,
    count: int,
    tiles: int,
    capacity: int,  # pairs that fit in keys and pairs; at least N
    measuring: int,  # 1: there is no room yet; 0: what does not fit becomes one list
    counts: I32,
    sums: I32,  # becomes the number of pairs before each block
    # [2 tiles + 3]: where each list begins; the number of pairs; the length of the one list, -1 if
    # there is none; the number of long lists; the tiles, those with long lists first
    offsets: I32,
    keys: I64,
    pairs: I32,
    seen: I64,  # [1] the most pairs so far
    told: I64,  # [1] the same, in the host's memory
):
    plan_native(
        drawn_depths, count, tiles, capacity, measuring, counts, sums, offsets, keys, pairs, seen,
        told,
    )  # fmt: skip


@wp.func_native(list_source.PLACE % _SIZES)
def place_native(
    row: int, records: F32, drawn_depths: F32, count: int, rows: int, across: int, down: int,
    width: int, counts: I32, first: I32, slots: I32, sums: I32, offsets: I32, keys: I64,
    owners: I32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=list_source.BLOCK)
def place_pairs(
    records: F32,
    drawn_depths: F32,
    count: int,
    rows: int,
    across: int,
    down: int,
    width: int,
    counts: I32,  # becomes zero
    first: I32,  # becomes the slot of each row's first pair
    slots: I32,
    sums: I32,
    offsets: I32,
    keys: I64,  # bits of the depth in the high half, slot in the low
    owners: I32,  # row of each slot
):
    place_native(
        wp.tid(), records, drawn_depths, count, rows, across, down, width, counts, first, slots,
        sums, offsets, keys, owners,
    )  # fmt: skip


@wp.func_native(order_source.SORT % _SIZES)
def sort_native(
    block: int, blocks: int, tiles: int, offsets: I32, keys: I64, owners: I32, pairs: I32
): ...  # fmt: skip


@wp.kernel(launch_bounds=(order_source.SORT_BLOCK, 3))
def sort_lists(
    blocks: int,  # of the launch
    tiles: int,
    offsets: I32,
    keys: I64,
    owners: I32,
    pairs: I32,  # [capacity, 2]: row and slot
):
    sort_native(wp.tid() // SORT_BLOCK, blocks, tiles, offsets, keys, owners, pairs)
