# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# Warp's arrays annotate as values, and float(0.0) declares a variable that a loop may change.
"""The native CPU kernels: depth order, tile intersections, and the tile loops of `tile_source`.

Where several workers run a kernel at once, each makes the same call and takes work items from the
shared `counters`. What an item writes does not depend on the worker.
"""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.cpu import tile_source
from hoigs.rasterizers.warp.intersect.tile_spans import span, tile_row_range
from hoigs.rasterizers.warp.records import F32, I32, RECORD, U64

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS, "max_unroll": 1})

RECORD_C = wp.constant(RECORD)
DIGIT = wp.constant(2048)  # radix sort takes 11 bits at a time
HISTOGRAM = 3 * 2048
# entries of `counters`: the next work item of each parallel stage, results of the serial stages
COUNT_WORK = wp.constant(0)
SCATTER_WORK = wp.constant(1)
TILE_WORK = wp.constant(2)
N_VISIBLE = 3
N_VISIBLE_C = wp.constant(N_VISIBLE)
N_INTERSECTIONS = 4
N_INTERSECTIONS_C = wp.constant(N_INTERSECTIONS)
COUNTERS = 8


AHEAD = wp.constant(8)  # a record is prefetched so many splats before it is read


@wp.func_native(tile_source.NEXT_WORK_ITEM)
def next_work_item(counters: I32, counter: int) -> int: ...


@wp.func_native(tile_source.PREFETCH)
def prefetch(array: F32, index: int): ...


@wp.kernel
def sort_by_depth(
    records: F32,
    drawn_depths: F32,  # negative where nothing is drawn
    count: int,
    tile_height: int,
    tiles_y: int,  # tiles
    chunks: int,
    keys: I32,  # [2 count] scratch
    order: I32,  # [2 count]; the result is in the first half
    histogram: I32,  # [3 DIGIT], zero
    spans_before: I32,  # [chunks + 1]
    counters: I32,
):
    """Gaussians that are drawn, nearest first, ties by index; one thread (0.2 ms for 20,000)."""
    visible = int(0)
    for row in range(count):
        key = wp.cast(drawn_depths[row], wp.int32)
        if key > 0:
            keys[visible] = key
            order[visible] = row
            visible += 1
            for digit in range(3):
                bucket = digit * DIGIT + ((key >> (11 * digit)) & (DIGIT - 1))
                histogram[bucket] = histogram[bucket] + 1
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
                bucket = digit * DIGIT + ((key >> (11 * digit)) & (DIGIT - 1))
                place = histogram[bucket]
                histogram[bucket] = place + 1
                keys[target + place] = key
                order[target + place] = order[source + j]
            source = target
    if source != 0:
        for j in range(visible):
            order[j] = order[source + j]
    counters[N_VISIBLE_C] = visible
    # upper bound of the spans of each chunk; a span is the tiles of one splat in one row of tiles
    total_spans = int(0)
    for chunk in range(chunks):
        spans_before[chunk] = total_spans
        for j in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            prefetch(records, order[wp.min(j + AHEAD, visible - 1)] * RECORD_C)
            tile_rows = tile_row_range(records, order[j] * RECORD_C, tile_height, tiles_y)
            total_spans += tile_rows[1] - tile_rows[0] + 1
    spans_before[chunks] = total_spans


@wp.kernel
def count_intersections(
    records: F32, order: I32, tile_height: int, tiles_x: int, tiles_y: int, width: int, chunks: int,
    spans_before: I32,
    spans: I32,  # [spans, 3]: row of the Gaussian, first tile, number of tiles
    span_counts: I32,  # [chunks]
    tile_counts: I32,  # [chunks, tiles], zero
    tiles_per_gaussian: I32,  # [N], zero
    counters: I32,
):  # fmt: skip
    """Find the tiles that splats touch; count them by chunk of the depth order and by tile."""
    visible = counters[N_VISIBLE_C]
    chunk = next_work_item(counters, COUNT_WORK)
    while chunk < chunks:
        q = spans_before[chunk]
        mine = chunk * tiles_x * tiles_y
        for j in range(visible * chunk // chunks, visible * (chunk + 1) // chunks):
            prefetch(records, order[wp.min(j + AHEAD, visible - 1)] * RECORD_C)
            row = order[j]
            r = row * RECORD_C
            total = int(0)
            tile_rows = tile_row_range(records, r, tile_height, tiles_y)
            for ty in range(tile_rows[0], tile_rows[1] + 1):
                s = span(records, r, ty, tile_height, tiles_x, width)
                if s[1] >= s[0]:
                    spans[3 * q] = row
                    spans[3 * q + 1] = ty * tiles_x + s[0]
                    spans[3 * q + 2] = s[1] - s[0] + 1
                    q += 1
                    total += s[1] - s[0] + 1
                    for t in range(mine + ty * tiles_x + s[0], mine + ty * tiles_x + s[1] + 1):
                        tile_counts[t] = tile_counts[t] + 1
            tiles_per_gaussian[row] = total
        span_counts[chunk] = q - spans_before[chunk]
        chunk = next_work_item(counters, COUNT_WORK)


@wp.kernel
def place_intersections(
    tiles: int,
    chunks: int,
    count: int,
    tile_counts: I32,  # becomes the index of each chunk's first intersection in each tile
    offsets: I32,  # [tiles + 1]
    tiles_per_gaussian: I32,
    first_partial: I32,  # [N] index in `partials` of a Gaussian's first
    counters: I32,
):
    """Running sums, one thread."""
    partial = int(0)
    for row in range(count):
        first_partial[row] = partial
        partial += tiles_per_gaussian[row]
    total = wp.int64(0)
    for tile in range(chunks * tiles):
        total += wp.int64(tile_counts[tile])
    if total > wp.int64(2147483647):
        counters[N_INTERSECTIONS_C] = -1
        return
    place = int(0)
    for tile in range(tiles):
        offsets[tile] = place
        for chunk in range(chunks):
            here = tile_counts[chunk * tiles + tile]
            tile_counts[chunk * tiles + tile] = place
            place += here
    offsets[tiles] = place
    counters[N_INTERSECTIONS_C] = place


@wp.kernel
def scatter_intersections(
    tiles: int, chunks: int, spans_before: I32, spans: I32, span_counts: I32, places: I32,
    first_partial: I32,
    indices: I32,  # [intersections, 2]: Gaussian, partial
    counters: I32,
):  # fmt: skip
    """Write `indices`. Chunks follow the depth order, so the intersections of each tile do too."""
    chunk = next_work_item(counters, SCATTER_WORK)
    while chunk < chunks:
        start = spans_before[chunk]
        partial = int(0)
        last = int(-1)
        for q in range(start, start + span_counts[chunk]):
            row = spans[3 * q]
            tile = chunk * tiles + spans[3 * q + 1]
            length = spans[3 * q + 2]
            if row != last:
                partial = first_partial[row]
                last = row
            for t in range(tile, tile + length):
                place = places[t]
                places[t] = place + 1
                indices[2 * place] = row
                indices[2 * place + 1] = partial
                partial += 1
        chunk = next_work_item(counters, SCATTER_WORK)


@wp.func_native(tile_source.FORWARD)
def forward_native(
    counters: I32, counter: int, tile_height: int, tiles: int, tiles_x: int, width: int,
    height: int, max_alpha: float, log2_min_alpha: float, min_transmittance: float,
    records: F32, indices: I32, offsets: I32, features: F32, channels: int, background: F32,
    background_stride: int, color: F32, alpha: F32, depth: F32, feature_image: F32,
): ...  # fmt: skip


@wp.kernel
def forward_tiles(
    counters: I32, tile_height: int, tiles: int, tiles_x: int, width: int, height: int,
    max_alpha: float, log2_min_alpha: float,
    min_transmittance: float,  # negative: never stop
    records: F32, indices: I32, offsets: I32,
    features: F32,  # [N, channels]
    channels: int,
    background: F32,  # [3] with stride 0, or [H, W, 3] with stride 3
    background_stride: int, color: F32, alpha: F32, depth: F32,
    feature_image: F32,  # [H, W, channels]
):  # fmt: skip
    forward_native(
        counters, TILE_WORK, tile_height, tiles, tiles_x, width, height, max_alpha, log2_min_alpha,
        min_transmittance, records, indices, offsets, features, channels, background,
        background_stride, color, alpha, depth, feature_image,
    )  # fmt: skip


@wp.func_native(tile_source.BACKWARD)
def backward_native(
    counters: I32, counter: int, tile_height: int, tiles: int, tiles_x: int, width: int,
    height: int, max_alpha: float, log2_min_alpha: float, min_transmittance: float,
    records: F32, indices: I32, offsets: I32, features: F32, channels: int, background: F32,
    background_stride: int, color: F32, alpha: F32, depth: F32, feature_image: F32,
    v_color: F32, v_alpha: F32, v_depth: F32, v_feature_image: F32, partials: F32,
): ...  # fmt: skip


@wp.kernel
def backward_tiles(
    counters: I32, tile_height: int, tiles: int, tiles_x: int, width: int, height: int,
    max_alpha: float, log2_min_alpha: float, min_transmittance: float, records: F32, indices: I32,
    offsets: I32, features: F32, channels: int, background: F32, background_stride: int, color: F32,
    alpha: F32, depth: F32, feature_image: F32, v_color: F32, v_alpha: F32, v_depth: F32,
    v_feature_image: F32,
    partials: F32,  # [intersections, MOMENTS + channels], zero
):  # fmt: skip
    backward_native(
        counters, TILE_WORK, tile_height, tiles, tiles_x, width, height, max_alpha, log2_min_alpha,
        min_transmittance, records, indices, offsets, features, channels, background,
        background_stride, color, alpha, depth, feature_image, v_color, v_alpha, v_depth,
        v_feature_image, partials,
    )  # fmt: skip


@wp.func_native(tile_source.QUEUE)
def write_queue_address(address: U64): ...


@wp.kernel
def queue_address(address: U64):
    """Address of a C function that OpenMP threads can call (see `workers`)."""
    write_queue_address(address)


@wp.kernel
def sum_numbers(total: I32):
    total[0] = total[0] + wp.tid()


@wp.func_native(tile_source.LANES)
def write_lanes(lanes: I32): ...


@wp.kernel
def count_lanes(lanes: I32):
    """How many floats a vector of the tile loops holds on this machine."""
    write_lanes(lanes)
