"""The portable CPU kernels: those of CUDA as scalar code, intersections sorted by torch."""

from __future__ import annotations

from typing import Any

import torch

from hoigs.rasterizers.warp.blend import absolute_kernels, pixel_kernels, pixel_source
from hoigs.rasterizers.warp.common.frame import Settings, TileIntersections, check_addressable
from hoigs.rasterizers.warp.cpu.pipeline import CpuPipeline
from hoigs.rasterizers.warp.intersect import portable_kernels
from hoigs.rasterizers.warp.intersect.tile_spans import TILE_WIDTH
from hoigs.rasterizers.warp.project.arguments import Projected


class PortablePipeline(CpuPipeline):
    """Renders with `blend.pixel_kernels`, one lane after the other."""

    forward_kernel, backward_kernel = pixel_kernels.forward_pixels, pixel_kernels.backward_pixels
    absolute_kernel = absolute_kernels.absolute_pixels

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
