# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# Warp's arrays annotate as values, and int(0) declares a variable that a loop may change.
"""Kernels that list the Gaussians of each tile by sorting 64-bit keys: the portable CPU path."""

from hoigs.rasterizers.warp.records import F32, I32, I64, RECORD
from hoigs.rasterizers.warp.runtime import CPU_FLAGS, wp
from hoigs.rasterizers.warp.tile_spans import span, tile_rows_under

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

RECORD_C = wp.constant(RECORD)
NO_TILE = wp.constant(wp.int64(2**62))


@wp.kernel
def count_tiles(
    records: F32,
    drawn_depths: F32,
    rows: int,  # pixels of a tile's height
    across: int,
    down: int,
    width: int,
    slots: I32,  # [N] how many tiles a Gaussian touches
    base: int,
    count: int,
):
    row = wp.tid() + base
    if row >= count:
        return
    total = int(0)
    if drawn_depths[row] > 0.0:
        r = row * RECORD_C
        under = tile_rows_under(records, r, rows, down)
        for ty in range(under[0], under[1] + 1):
            s = span(records, r, ty, rows, across, width)
            total += wp.max(s[1] - s[0] + 1, 0)
    slots[row] = total


@wp.kernel
def write_keys(
    records: F32,
    drawn_depths: F32,
    rows: int,
    across: int,
    down: int,
    width: int,
    first: I32,  # [N] slot of a Gaussian's first pair
    slots: I32,
    keys: I64,  # [M] tile in the high half, bits of the depth in the low
    owners: I32,  # [M] row
    base: int,
    count: int,
):
    row = wp.tid() + base
    if row >= count:
        return
    slot = int(first[row])
    end = slot + slots[row]
    if slot == end:
        return
    depth = wp.int64(wp.cast(drawn_depths[row], wp.int32))
    r = row * RECORD_C
    under = tile_rows_under(records, r, rows, down)
    for ty in range(under[0], under[1] + 1):
        s = span(records, r, ty, rows, across, width)
        for tx in range(s[0], s[1] + 1):
            if slot < end:
                keys[slot] = (wp.int64(ty * across + tx) << wp.int64(32)) | depth
                owners[slot] = row
                slot += 1
    # Rounded otherwise than in count_tiles, a span may come out shorter; never leave a hole.
    for hole in range(slot, end):
        keys[hole] = NO_TILE
        owners[hole] = row


@wp.kernel
def write_lists(
    keys: I64,  # sorted
    places: I64,  # where each was before
    owners: I32,
    tiles: int,
    pairs: I32,
    offsets: I32,  # [tiles + 1]
    base: int,
    count: int,
):
    k = wp.tid() + base
    if k >= count:
        return
    slot = int(places[k])
    pairs[2 * k] = owners[slot]
    pairs[2 * k + 1] = slot
    tile = wp.min(int(keys[k] >> wp.int64(32)), tiles)
    before = int(-1)
    if k > 0:
        before = wp.min(int(keys[k - 1] >> wp.int64(32)), tiles)
    for t in range(before + 1, tile + 1):
        offsets[t] = k
    if k == count - 1:
        for t in range(tile + 1, tiles + 1):
            offsets[t] = count
