# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# Warp's arrays annotate as values, and int(0) declares a variable that a loop may change.
"""Tile intersections by sorting 64-bit keys, for the portable CPU kernels."""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.intersect.tile_spans import span, tile_row_range
from hoigs.rasterizers.warp.records import F32, I32, I64, RECORD

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

RECORD_C = wp.constant(RECORD)
NO_TILE = wp.constant(wp.int64(2**62))


@wp.kernel
def count_tiles(
    records: F32, drawn_depths: F32,
    tile_height: int,  # pixels of a tile's height
    tiles_x: int, tiles_y: int, width: int,
    tiles_per_gaussian: I32,  # [N] how many tiles a Gaussian touches
    base: int, count: int,
):  # fmt: skip
    row = wp.tid() + base
    if row >= count:
        return
    total = int(0)
    if drawn_depths[row] > 0.0:
        r = row * RECORD_C
        tile_rows = tile_row_range(records, r, tile_height, tiles_y)
        for ty in range(tile_rows[0], tile_rows[1] + 1):
            s = span(records, r, ty, tile_height, tiles_x, width)
            total += wp.max(s[1] - s[0] + 1, 0)
    tiles_per_gaussian[row] = total


@wp.kernel
def write_keys(
    records: F32, drawn_depths: F32, tile_height: int, tiles_x: int, tiles_y: int, width: int,
    first_partial: I32,  # [N] index in `partials` of a Gaussian's first
    tiles_per_gaussian: I32,
    keys: I64,  # [M] tile in the high half, bits of the depth in the low
    owners: I32,  # [M] the Gaussian of each partial
    base: int, count: int,
):  # fmt: skip
    row = wp.tid() + base
    if row >= count:
        return
    partial = int(first_partial[row])
    end = partial + tiles_per_gaussian[row]
    if partial == end:
        return
    depth = wp.int64(wp.cast(drawn_depths[row], wp.int32))
    r = row * RECORD_C
    tile_rows = tile_row_range(records, r, tile_height, tiles_y)
    for ty in range(tile_rows[0], tile_rows[1] + 1):
        s = span(records, r, ty, tile_height, tiles_x, width)
        for tx in range(s[0], s[1] + 1):
            if partial < end:
                keys[partial] = (wp.int64(ty * tiles_x + tx) << wp.int64(32)) | depth
                owners[partial] = row
                partial += 1
    # rounding may make a span shorter here than in count_tiles: fill what remains
    for hole in range(partial, end):
        keys[hole] = NO_TILE
        owners[hole] = row


@wp.kernel
def write_offsets(
    keys: I64,  # sorted
    order: I64,  # where each was before sorting
    owners: I32, tiles: int, indices: I32,
    offsets: I32,  # [tiles + 1]
    base: int, count: int,
):  # fmt: skip
    k = wp.tid() + base
    if k >= count:
        return
    partial = int(order[k])
    indices[2 * k] = owners[partial]
    indices[2 * k + 1] = partial
    tile = wp.min(int(keys[k] >> wp.int64(32)), tiles)
    before = int(-1)
    if k > 0:
        before = wp.min(int(keys[k - 1] >> wp.int64(32)), tiles)
    for t in range(before + 1, tile + 1):
        offsets[t] = k
    if k == count - 1:
        for t in range(tile + 1, tiles + 1):
            offsets[t] = count
