"""The native CPU kernels: vectors in registers, one tile at a time on each core."""

from __future__ import annotations

from typing import Any

import torch

from hoigs.rasterizers.warp.common.frame import Settings, TileIntersections, check_addressable
from hoigs.rasterizers.warp.cpu import absolute_kernels
from hoigs.rasterizers.warp.cpu import native_kernels as kernels
from hoigs.rasterizers.warp.cpu.pipeline import CpuPipeline
from hoigs.rasterizers.warp.cpu.vector_source import MAX_ROWS
from hoigs.rasterizers.warp.intersect.tile_spans import TILE_WIDTH
from hoigs.rasterizers.warp.project.arguments import Projected


class NativePipeline(CpuPipeline):
    """Renders with `native_kernels`, where the stages are described."""

    forward_kernel, backward_kernel = kernels.forward_tiles, kernels.backward_tiles
    absolute_kernel = absolute_kernels.absolute_tiles

    def intersect(self, projected: Projected, settings: Settings) -> TileIntersections:
        count, records = projected.depths.shape[0], projected.records
        height = tile_height(settings)
        tiles_x, tiles_y = -(-settings.width // TILE_WIDTH), -(-settings.height // height)
        tiles, chunks = tiles_x * tiles_y, self.cores.chunks(count)
        sizes = [kernels.COUNTERS, chunks + 1, count, chunks * tiles, kernels.HISTOGRAM]
        zeros = torch.zeros(sum(sizes), dtype=torch.int32)
        counters, spans_before, tiles_per_gaussian, tile_counts, histogram = zeros.split(sizes)
        sizes = [2 * count, 2 * count, count, tiles + 1, chunks]
        empty = torch.empty(sum(sizes), dtype=torch.int32)
        keys, order, first_partial, offsets, span_counts = empty.split(sizes)
        self.cores.once(
            kernels.sort_by_depth,
            [records, projected.drawn_depths, count, height, tiles_y, chunks, keys, order,
             histogram, spans_before, counters],
        )  # fmt: skip
        spans = torch.empty(3 * int(spans_before[-1]), dtype=torch.int32)
        self.cores.together(
            kernels.count_intersections, chunks,
            [records, order, height, tiles_x, tiles_y, settings.width, chunks, spans_before, spans,
             span_counts, tile_counts, tiles_per_gaussian, counters],
        )  # fmt: skip
        self.cores.once(
            kernels.place_intersections,
            [tiles, chunks, count, tile_counts, offsets, tiles_per_gaussian, first_partial,
             counters],
        )  # fmt: skip
        total = int(counters[kernels.N_INTERSECTIONS])
        if total < 0:  # more than an int32 holds
            check_addressable(2**31, f"the intersections of {count} Gaussians with {tiles} tiles")
        indices = torch.empty(total, 2, dtype=torch.int32)
        self.cores.together(
            kernels.scatter_intersections, chunks,
            [tiles, chunks, spans_before, spans, span_counts, tile_counts, first_partial, indices,
             counters],
        )  # fmt: skip
        return TileIntersections(
            height, tiles_x, tiles_y, offsets, indices, first_partial, tiles_per_gaussian
        )

    def _tiles(self, kernel: Any, intersections: TileIntersections, arguments: list[Any]) -> None:
        counters = torch.zeros(kernels.COUNTERS, dtype=torch.int32)
        cores = min(
            self.cores.number(intersections.tiles), self.cores.chunks(4 * intersections.count)
        )
        self.cores.together(kernel, cores, [counters, intersections.tile_height, *arguments])


def tile_height(settings: Settings) -> int:
    """Pixels: tall tiles have fewer intersections, low ones spread better over cores.

    It does not depend on the number of cores, so that results do not.
    """
    pixels = settings.width * settings.height
    return 16 if pixels <= 96 * 96 else 32 if pixels <= 160 * 160 else MAX_ROWS
