"""The fast CPU path: stages of `projection` and `cpu_kernels` on several cores."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.rasterizers.warp import cpu_kernels as kernels
from hoigs.rasterizers.warp.calls import flat, record
from hoigs.rasterizers.warp.cpu_source import MAX_ROWS
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings
from hoigs.rasterizers.warp.projecting import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
)
from hoigs.rasterizers.warp.projection import project, project_adjoint
from hoigs.rasterizers.warp.records import MOMENTS, SMALLEST_ALPHA
from hoigs.rasterizers.warp.workers import SerialWorkers, Workers

ROWS_PER_WORKER = 512  # fewer Gaussians than this are not worth another core
INT32 = 2**31 - 1


class NativePath:
    """Renders with vectors in registers, one tile at a time on each core.

    Args:
        workers: how launches are spread over cores.
        threads: how many cores; None is torch's own number, asked at each render.
    """

    def __init__(self, workers: Workers, threads: int | None) -> None:
        self.workers, self.threads = workers, threads

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        self._each_row(project, inputs.count, project_arguments(inputs, settings, out))
        return out

    def bin(self, projected: Projected, settings: Settings) -> Lists:
        """Tile lists in order of depth. See `cpu_kernels` for the stages."""
        count = projected.depths.shape[0]
        rows = tile_rows(settings)
        across, down = -(-settings.width // kernels.TILE_WIDTH), -(-settings.height // rows)
        tiles, chunks = across * down, self._chunks(count)
        counters, spans_before, slots, tile_counts, histogram = torch.zeros(
            kernels.COUNTERS + chunks + 1 + count + chunks * tiles + kernels.HISTOGRAM,
            dtype=torch.int32,
        ).split([kernels.COUNTERS, chunks + 1, count, chunks * tiles, kernels.HISTOGRAM])
        keys, order, first, offsets, span_counts = torch.empty(
            5 * count + tiles + 1 + chunks, dtype=torch.int32
        ).split([2 * count, 2 * count, count, tiles + 1, chunks])
        records, work, before = flat(projected.records), flat(counters), flat(spans_before)
        order, span_counts, places = flat(order), flat(span_counts), flat(tile_counts)
        self._once(
            kernels.sort_by_depth,
            [records, flat(projected.drawn_depths), count, rows, down, chunks, flat(keys), order,
             flat(histogram), before, work],
        )  # fmt: skip
        spans = flat(torch.empty(3 * int(spans_before[-1]), dtype=torch.int32))
        self._together(
            kernels.count_pairs, chunks,
            [records, order, rows, across, down, settings.width, chunks, before, spans,
             span_counts, places, flat(slots), work],
        )  # fmt: skip
        self._once(
            kernels.place_pairs,
            [tiles, chunks, count, places, flat(offsets), flat(slots), flat(first), work],
        )
        pairs = torch.empty(int(counters[kernels.N_PAIRS]), 2, dtype=torch.int32)
        self._together(
            kernels.scatter_pairs, chunks,
            [tiles, chunks, before, spans, span_counts, places, flat(first), flat(pairs), work],
        )  # fmt: skip
        return Lists(rows, across, down, pairs, offsets, first, slots)

    def composite(
        self, inputs: Inputs, settings: Settings, projected: Tensor, lists: Lists
    ) -> Images:
        size = (settings.height, settings.width)
        new = inputs.means.new_empty
        images = Images(new(*size, 3), new(size), new(size), new(*size, inputs.channels))
        arguments = _tile_arguments(inputs, settings, projected, lists, images)
        tiles = lists.across * lists.down
        self._together(kernels.forward_tiles, self._tile_workers(tiles), arguments)
        return images

    def gradients(
        self,
        inputs: Inputs,
        settings: Settings,
        records: Tensor,
        lists: Lists,
        images: Images,
        upstream: Images,
        pose: bool,
    ) -> Gradients:
        stride = MOMENTS + inputs.channels
        partials = torch.zeros(lists.pairs.shape[0], stride)
        arguments = _tile_arguments(inputs, settings, records, lists, images)
        arguments += [flat(x) for x in (upstream.color, upstream.alpha, upstream.depth)]
        arguments += [flat(upstream.extra), flat(partials)]
        tiles = lists.across * lists.down
        self._together(kernels.backward_tiles, self._tile_workers(tiles), arguments)
        out = Gradients(inputs, pose)
        arguments = adjoint_arguments(inputs, settings, records, lists, partials, out)
        self._each_row(project_adjoint, inputs.count, arguments)
        return out

    def _cores(self) -> int:
        return self.threads or torch.get_num_threads()

    def _chunks(self, count: int) -> int:
        return max(1, min(self._cores(), count // ROWS_PER_WORKER))

    def _tile_workers(self, tiles: int) -> int:
        return min(self._cores(), tiles)

    def _once(self, kernel: Any, arguments: list[Any]) -> None:
        record(kernel, 1, arguments).launch()

    def _together(self, kernel: Any, workers: int, arguments: list[Any]) -> None:
        """The same launch on several cores, which share the work through `counters`."""
        self._run([record(kernel, 1, arguments)] * workers)

    def _each_row(self, kernel: Any, count: int, arguments: list[Any]) -> None:
        """A kernel of one thread a Gaussian, in equal ranges of rows."""
        if count == 0:
            return
        chunks = self._chunks(count)
        size = -(-count // chunks)
        self._run([record(kernel, size, [*arguments, j * size, count]) for j in range(chunks)])

    def _run(self, launches: list[Any]) -> None:
        (SerialWorkers() if len(launches) == 1 else self.workers).run(launches)


def tile_rows(settings: Settings) -> int:
    """Height of a tile: tall ones make fewer pairs, low ones spread better over cores."""
    pixels = settings.width * settings.height
    return 16 if pixels <= 128 * 128 else 32 if pixels <= 256 * 256 else MAX_ROWS


def _tile_arguments(
    inputs: Inputs, settings: Settings, records: Tensor, lists: Lists, images: Images
) -> list[Any]:
    return [
        flat(torch.zeros(kernels.COUNTERS, dtype=torch.int32)),
        lists.across * lists.down,
        lists.across,
        lists.tile_rows,
        settings.width,
        settings.height,
        settings.max_alpha,
        math.log2(max(settings.min_alpha, SMALLEST_ALPHA)),
        settings.min_transmittance if settings.min_transmittance > 0 else -1.0,
        flat(records),
        flat(lists.pairs),
        flat(lists.offsets),
        flat(inputs.features),
        inputs.channels,
        flat(inputs.background),
        3 if inputs.background.dim() == 3 else 0,
        flat(images.color),
        flat(images.alpha),
        flat(images.depth),
        flat(images.extra),
    ]


def check_size(settings: Settings, channels: int) -> None:
    """Raise when an image would not be addressable with the kernels' 32-bit indices."""
    numbers = settings.width * settings.height * max(3, channels)
    if numbers > INT32:
        raise RenderError(
            f"WarpRasterizer: {settings.width}x{settings.height} with {channels} feature channels "
            "is too large for one render; render parts, or fewer channels at a time"
        )
