"""The portable path of the CPU: CUDA's pixel kernels as scalar code, lists sorted by torch."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.rasterizers.warp import pair_kernels, pixel_kernels, pixel_source
from hoigs.rasterizers.warp.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
    tile_arguments,
    upstream_arguments,
)
from hoigs.rasterizers.warp.calls import flat
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings, check_addressable
from hoigs.rasterizers.warp.launchers import Cores
from hoigs.rasterizers.warp.projection import project, project_adjoint
from hoigs.rasterizers.warp.records import MOMENTS
from hoigs.rasterizers.warp.tile_spans import TILE_WIDTH


class PixelPath:
    """Renders with one lane for a few pixels, one lane after the other.

    Args:
        cores: what runs the kernels.
    """

    def __init__(self, cores: Cores) -> None:
        self.cores = cores

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        arguments = project_arguments(inputs, settings, out)
        self.cores.each(project, inputs.count, arguments)
        return out

    def bin(self, projected: Projected, settings: Settings) -> Lists:
        """Tile lists by depth, ties by index: slots rise with rows, and the sort is stable."""
        depths = projected.drawn_depths
        count, rows = depths.shape[0], pixel_source.TILE_ROWS
        across, down = -(-settings.width // TILE_WIDTH), -(-settings.height // rows)
        ints = {"dtype": torch.int32, "device": depths.device}
        slots = torch.empty(count, **ints)
        splats = [flat(projected.records), flat(depths), rows, across, down, settings.width]
        self.cores.each(pair_kernels.count_tiles, count, [*splats, flat(slots)])
        ends = slots.cumsum(0, dtype=torch.int64)
        total = int(ends[-1]) if count else 0
        check_addressable(total, f"the splats of {count} Gaussians in {across * down} tiles")
        first = (ends - slots).int()
        keys = torch.empty(total, dtype=torch.int64, device=depths.device)
        owners = torch.empty(total, **ints)
        self.cores.each(
            pair_kernels.write_keys,
            count,
            [*splats, flat(first), flat(slots), flat(keys), flat(owners)],
        )
        keys, places = torch.sort(keys, stable=True)
        pairs = torch.empty(total, 2, **ints)
        offsets = torch.zeros(across * down + 1, **ints)
        self.cores.each(
            pair_kernels.write_lists,
            total,
            [flat(keys), flat(places), flat(owners), across * down, flat(pairs), flat(offsets)],
        )
        return Lists(rows, across, down, pairs, offsets, first, slots)

    def composite(
        self, inputs: Inputs, settings: Settings, records: Tensor, lists: Lists
    ) -> Images:
        images = Images.empty(inputs, settings)
        self.cores.each(
            pixel_kernels.forward_pixels,
            lists.tiles * pixel_source.LANES,
            tile_arguments(inputs, settings, records, lists, images),
        )
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
        check_addressable(lists.pairs.shape[0] * stride, f"{lists.pairs.shape[0]} splats in tiles")
        partials = inputs.means.new_zeros(lists.pairs.shape[0], stride)
        arguments = tile_arguments(inputs, settings, records, lists, images)
        arguments += upstream_arguments(upstream, partials)
        self.cores.each(pixel_kernels.backward_pixels, lists.tiles * pixel_source.LANES, arguments)
        out = Gradients(inputs, pose)
        self.cores.each(
            project_adjoint,
            inputs.count,
            adjoint_arguments(inputs, settings, records, lists, partials, out),
        )
        return out
