# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# Warp's arrays annotate as values, and float(0.0) declares a variable that a loop may change.
"""Kernels of the fast CPU path: depth order, tile lists, and the tile loops of `cpu_source`.

A kernel that several workers run at once draws its pieces of work from `counters`, so that every
worker makes the same call. What a piece writes does not depend on who does it.
"""

from hoigs.rasterizers.warp import cpu_source
from hoigs.rasterizers.warp.records import F32, I32, RECORD, U64
from hoigs.rasterizers.warp.runtime import CPU_FLAGS, wp
from hoigs.rasterizers.warp.tile_spans import span, tile_rows_under

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS, "max_unroll": 1})

RECORD_C = wp.constant(RECORD)
DIGIT = wp.constant(2048)  # radix sort takes 11 bits at a time
HISTOGRAM = 3 * 2048
# slots of `counters`: work drawn by each stage, then results of the serial stages
COUNT_WORK = wp.constant(0)
SCATTER_WORK = wp.constant(1)
TILE_WORK = wp.constant(2)
N_VISIBLE = 3
N_VISIBLE_C = wp.constant(N_VISIBLE)
N_PAIRS = 4
N_PAIRS_C = wp.constant(N_PAIRS)
COUNTERS = 8


AHEAD = wp.constant(8)  # how many splats before its turn a record is fetched


@wp.func_native(cpu_source.TAKE)
def take(counters: I32, counter: int) -> int: ...


@wp.func_native(cpu_source.PREFETCH)
def prefetch(array: F32, index: int): ...


@wp.kernel
def sort_by_depth(
    records: F32,
    drawn_depths: F32,  # negative where nothing is drawn
    count: int,
    rows: int,
    down: int,  # tiles
    chunks: int,
    keys: I32,  # [2 count] scratch
    order: I32,  # [2 count]; the result is in the first half
    histogram: I32,  # [3 DIGIT], zero
    spans_before: I32,  # [chunks + 1]
    counters: I32,
):
    """Rows that are drawn, nearest first, ties by index; one thread (0.2 ms for 20,000)."""
    visible = int(0)
    for row in range(count):
        key = wp.cast(drawn_depths[row], wp.int32)
        if key > 0:
            keys[visible] = key
            order[visible] = row
            visible += 1
            for digit in range(3):
                slot = digit * DIGIT + ((key >> (11 * digit)) & (DIGIT - 1))
                histogram[slot] = histogram[slot] + 1
    source = int(0)
    for digit in range(3):
        total = int(0)
        distinct = int(0)
        for j in range(digit * DIGIT, (digit + 1) * DIGIT):
            here = histogram[j]
            histogram[j] = total
            total += here
            if here > 0:
                distinct += 1
        if distinct > 1:
            target = count - source
            for j in range(visible):
                key = keys[source + j]
                slot = digit * DIGIT + ((key >> (11 * digit)) & (DIGIT - 1))
                place = histogram[slot]
                histogram[slot] = place + 1
                keys[target + place] = key
                order[target + place] = order[source + j]
            source = target
    if source != 0:
        for j in range(visible):
            order[j] = order[source + j]
    counters[N_VISIBLE_C] = visible
    # room for the spans of each chunk: a span is the tiles of one row of tiles under one splat
    total_spans = int(0)
    for chunk in range(chunks):
        spans_before[chunk] = total_spans
        for j in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            prefetch(records, order[wp.min(j + AHEAD, visible - 1)] * RECORD_C)
            under = tile_rows_under(records, order[j] * RECORD_C, rows, down)
            total_spans += under[1] - under[0] + 1
    spans_before[chunks] = total_spans


@wp.kernel
def count_pairs(
    records: F32,
    order: I32,
    rows: int,
    across: int,
    down: int,
    width: int,
    chunks: int,
    spans_before: I32,
    spans: I32,  # [spans, 3]: row of the Gaussian, first tile, number of tiles
    span_counts: I32,  # [chunks]
    tile_counts: I32,  # [chunks, tiles], zero
    slots: I32,  # [N] pairs of each Gaussian, zero
    counters: I32,
):
    """Find the tiles under each splat; count them by chunk of the depth order and by tile."""
    visible = counters[N_VISIBLE_C]
    chunk = take(counters, COUNT_WORK)
    while chunk < chunks:
        q = spans_before[chunk]
        mine = chunk * across * down
        for j in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            prefetch(records, order[wp.min(j + AHEAD, visible - 1)] * RECORD_C)
            row = order[j]
            r = row * RECORD_C
            total = int(0)
            under = tile_rows_under(records, r, rows, down)
            for ty in range(under[0], under[1] + 1):
                s = span(records, r, ty, rows, across, width)
                if s[1] >= s[0]:
                    spans[3 * q] = row
                    spans[3 * q + 1] = ty * across + s[0]
                    spans[3 * q + 2] = s[1] - s[0] + 1
                    q += 1
                    total += s[1] - s[0] + 1
                    for t in range(mine + ty * across + s[0], mine + ty * across + s[1] + 1):
                        tile_counts[t] = tile_counts[t] + 1
            slots[row] = total
        span_counts[chunk] = q - spans_before[chunk]
        chunk = take(counters, COUNT_WORK)


@wp.kernel
def place_pairs(
    tiles: int,
    chunks: int,
    count: int,
    tile_counts: I32,  # becomes the place of each chunk's first pair in each tile
    offsets: I32,  # [tiles + 1]
    slots: I32,
    first: I32,  # [N] slot of a Gaussian's first pair
    counters: I32,
):
    """Running sums, one thread."""
    slot = int(0)
    for row in range(count):
        first[row] = slot
        slot += slots[row]
    total = wp.int64(0)
    for tile in range(chunks * tiles):
        total += wp.int64(tile_counts[tile])
    if total > wp.int64(2147483647):
        counters[N_PAIRS_C] = -1
        return
    place = int(0)
    for tile in range(tiles):
        offsets[tile] = place
        for chunk in range(chunks):
            here = tile_counts[chunk * tiles + tile]
            tile_counts[chunk * tiles + tile] = place
            place += here
    offsets[tiles] = place
    counters[N_PAIRS_C] = place


@wp.kernel
def scatter_pairs(
    tiles: int,
    chunks: int,
    spans_before: I32,
    spans: I32,
    span_counts: I32,
    places: I32,
    first: I32,
    pairs: I32,  # [pairs, 2]: row of the Gaussian, slot
    counters: I32,
):
    """Write the tile lists. Chunks follow the depth order, so each list does too."""
    chunk = take(counters, SCATTER_WORK)
    while chunk < chunks:
        start = spans_before[chunk]
        slot = int(0)
        last = int(-1)
        for q in range(start, start + span_counts[chunk]):
            row = spans[3 * q]
            tile = chunk * tiles + spans[3 * q + 1]
            length = spans[3 * q + 2]
            if row != last:
                slot = first[row]
                last = row
            for t in range(tile, tile + length):
                place = places[t]
                places[t] = place + 1
                pairs[2 * place] = row
                pairs[2 * place + 1] = slot
                slot += 1
        chunk = take(counters, SCATTER_WORK)


@wp.func_native(cpu_source.FORWARD)
def forward_native(
    counters: I32, counter: int, rows: int, tiles: int, across: int, width: int, height: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float, records: F32, pairs: I32,
    offsets: I32, features: F32, channels: int, background: F32, background_stride: int,
    color: F32, alpha: F32, depth: F32, extra: F32,
): ...  # fmt: skip


@wp.kernel
def forward_tiles(
    counters: I32,
    rows: int,
    tiles: int,
    across: int,
    width: int,
    height: int,
    max_alpha: float,
    log2_min_alpha: float,
    min_transmittance: float,  # negative: never stop
    records: F32,
    pairs: I32,
    offsets: I32,
    features: F32,  # [N, channels]
    channels: int,
    background: F32,  # [3] with stride 0, or [H, W, 3] with stride 3
    background_stride: int,
    color: F32,
    alpha: F32,
    depth: F32,
    extra: F32,  # [H, W, channels]
):
    forward_native(
        counters, TILE_WORK, rows, tiles, across, width, height, max_alpha, log2_min_alpha,
        min_transmittance, records, pairs, offsets, features, channels, background,
        background_stride, color, alpha, depth, extra,
    )  # fmt: skip


@wp.func_native(cpu_source.BACKWARD)
def backward_native(
    counters: I32, counter: int, rows: int, tiles: int, across: int, width: int, height: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float, records: F32, pairs: I32,
    offsets: I32, features: F32, channels: int, background: F32, background_stride: int,
    color: F32, alpha: F32, depth: F32, extra: F32,
    v_color: F32, v_alpha: F32, v_depth: F32, v_extra: F32, partials: F32,
): ...  # fmt: skip


@wp.kernel
def backward_tiles(
    counters: I32,
    rows: int,
    tiles: int,
    across: int,
    width: int,
    height: int,
    max_alpha: float,
    log2_min_alpha: float,
    min_transmittance: float,
    records: F32,
    pairs: I32,
    offsets: I32,
    features: F32,
    channels: int,
    background: F32,
    background_stride: int,
    color: F32,
    alpha: F32,
    depth: F32,
    extra: F32,
    v_color: F32,
    v_alpha: F32,
    v_depth: F32,
    v_extra: F32,
    partials: F32,  # [pairs, MOMENTS + channels], zero
):
    backward_native(
        counters, TILE_WORK, rows, tiles, across, width, height, max_alpha, log2_min_alpha,
        min_transmittance, records, pairs, offsets, features, channels, background,
        background_stride, color, alpha, depth, extra, v_color, v_alpha, v_depth, v_extra,
        partials,
    )  # fmt: skip


@wp.func_native(cpu_source.QUEUE)
def write_queue_address(address: U64): ...


@wp.kernel
def queue_address(address: U64):
    """Address of a C function that OpenMP's workers can enter (see `workers`)."""
    write_queue_address(address)


@wp.kernel
def sum_numbers(total: I32):
    total[0] = total[0] + wp.tid()


@wp.func_native(cpu_source.LANES)
def write_lanes(lanes: I32): ...


@wp.kernel
def count_lanes(lanes: I32):
    """How many floats a vector of the tile loops has on this machine."""
    write_lanes(lanes)
