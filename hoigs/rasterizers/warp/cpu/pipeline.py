"""The stages that the native and the portable CPU kernels have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor

from hoigs.rasterizers.warp.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
    tile_arguments,
    upstream_arguments,
)
from hoigs.rasterizers.warp.blend import absolute_kernels as scalar_absolute_kernels
from hoigs.rasterizers.warp.blend import pixel_kernels, pixel_source
from hoigs.rasterizers.warp.cpu import absolute_kernels
from hoigs.rasterizers.warp.cpu import native_kernels as kernels
from hoigs.rasterizers.warp.cpu.tile_source import MAX_ROWS
from hoigs.rasterizers.warp.cpu.workers import Cores
from hoigs.rasterizers.warp.frame import (
    Images,
    Inputs,
    Settings,
    TileIntersections,
    check_addressable,
)
from hoigs.rasterizers.warp.intersect import portable_kernels
from hoigs.rasterizers.warp.intersect.tile_spans import TILE_WIDTH
from hoigs.rasterizers.warp.project import kernels as pinhole
from hoigs.rasterizers.warp.project import optics
from hoigs.rasterizers.warp.records import ABSOLUTES, MOMENTS


class CpuPipeline(ABC):
    """Renders on the CPU.

    Args:
        cores: what runs the kernels.
    """

    forward_kernel: ClassVar[Any]
    backward_kernel: ClassVar[Any]
    absolute_kernel: ClassVar[Any]  # backward, with absolute gradients
    # what the kernels take besides, forward and backward
    further: ClassVar[tuple[tuple[Any, ...], tuple[Any, ...]]] = ((), ())

    def __init__(self, cores: Cores) -> None:
        self.cores = cores

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        kernel = (optics if settings.optics else pinhole).project
        self.cores.each(kernel, inputs.count, project_arguments(inputs, settings, out))
        return out

    @abstractmethod
    def intersect(self, projected: Projected, settings: Settings) -> TileIntersections:
        """The Gaussians of each tile, nearest first, ties by index."""

    def blend(
        self,
        inputs: Inputs,
        settings: Settings,
        records: Tensor,
        intersections: TileIntersections,
    ) -> Images:
        images = Images.empty(inputs, settings)
        arguments = tile_arguments(inputs, settings, records, intersections, images)
        arguments += self.further[0]
        self._tiles(self.forward_kernel, intersections, arguments)
        return images

    def gradients(
        self,
        inputs: Inputs,
        settings: Settings,
        records: Tensor,
        intersections: TileIntersections,
        images: Images,
        upstream: Images,
        pose: bool,
        absolute: bool,
        offsets: bool,
    ) -> Gradients:
        """Of all inputs; of the pose and the offsets, and absolute ones, where asked for."""
        out = Gradients(inputs, pose, absolute, offsets, settings.optics)
        out.sh = torch.empty_like(inputs.sh)
        count, stride = intersections.count, MOMENTS + inputs.channels + ABSOLUTES * absolute
        check_addressable(count * stride, f"{count} tile intersections")
        partials = inputs.means.new_zeros(count, stride)
        arguments = tile_arguments(inputs, settings, records, intersections, images)
        arguments += [*upstream_arguments(upstream, partials), *self.further[1]]
        kernel = self.absolute_kernel if absolute else self.backward_kernel
        self._tiles(kernel, intersections, arguments)
        bases = inputs.sh.shape[1], settings.active_bases
        arguments = adjoint_arguments(
            inputs, settings, bases, records, intersections.tiles_per_gaussian,
            (intersections.first_partial, partials), out,
        )  # fmt: skip
        kernel = (optics if settings.optics else pinhole).project_adjoint
        self.cores.each(kernel, inputs.count, arguments)
        return out

    @abstractmethod
    def _tiles(self, kernel: Any, intersections: TileIntersections, arguments: list[Any]) -> None:
        """Run a kernel for all tiles."""


# The native CPU kernels: vectors in registers, one tile at a time on each core.


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


# The portable CPU kernels: those of CUDA as scalar code, intersections sorted by torch.


class PortablePipeline(CpuPipeline):
    """Renders with `blend.pixel_kernels`, one lane after the other."""

    forward_kernel, backward_kernel = pixel_kernels.forward_pixels, pixel_kernels.backward_pixels
    absolute_kernel = scalar_absolute_kernels.absolute_pixels
    further = (
        (torch.empty(0, dtype=torch.int64), torch.empty(0, dtype=torch.int32), 0),
        (torch.empty(0, dtype=torch.uint8),),
    )

    def intersect(self, projected: Projected, settings: Settings) -> TileIntersections:
        depths, height = projected.drawn_depths, pixel_source.TILE_HEIGHT
        count = depths.shape[0]
        tiles_x, tiles_y = -(-settings.width // TILE_WIDTH), -(-settings.height // height)
        tiles_per_gaussian = torch.empty(count, dtype=torch.int32)
        splats = [projected.records, depths, height, tiles_x, tiles_y, settings.width]
        self.cores.each(portable_kernels.count_tiles, count, [*splats, tiles_per_gaussian])
        ends = tiles_per_gaussian.cumsum(0, dtype=torch.int64)
        total = int(ends[-1]) if count else 0
        check_addressable(
            total, f"the intersections of {count} Gaussians with {tiles_x * tiles_y} tiles"
        )
        first_partial = (ends - tiles_per_gaussian).int()
        keys = torch.empty(total, dtype=torch.int64)
        owners = torch.empty(total, dtype=torch.int32)
        arguments = [*splats, first_partial, tiles_per_gaussian, keys, owners]
        self.cores.each(portable_kernels.write_keys, count, arguments)
        # partials are numbered by Gaussian and the sort is stable, so ties are in order of index
        keys, order = torch.sort(keys, stable=True)
        indices = torch.empty(total, 2, dtype=torch.int32)
        offsets = torch.zeros(tiles_x * tiles_y + 1, dtype=torch.int32)
        arguments = [keys, order, owners, tiles_x * tiles_y, indices, offsets]
        self.cores.each(portable_kernels.write_offsets, total, arguments)
        return TileIntersections(
            height, tiles_x, tiles_y, offsets, indices, first_partial, tiles_per_gaussian
        )

    def _tiles(self, kernel: Any, intersections: TileIntersections, arguments: list[Any]) -> None:
        self.cores.each(kernel, intersections.tiles * pixel_source.LANES, arguments)
