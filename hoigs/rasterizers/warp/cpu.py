"""The fast CPU path: stages of `projection` and `cpu_kernels` on several cores."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp import cpu_kernels as kernels
from hoigs.rasterizers.warp.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
    tile_arguments,
    upstream_arguments,
)
from hoigs.rasterizers.warp.calls import flat
from hoigs.rasterizers.warp.cpu_vectors import MAX_ROWS
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings, check_addressable
from hoigs.rasterizers.warp.launchers import Cores
from hoigs.rasterizers.warp.projection import project, project_adjoint
from hoigs.rasterizers.warp.records import MOMENTS
from hoigs.rasterizers.warp.tile_spans import TILE_WIDTH


class NativePath:
    """Renders with vectors in registers, one tile at a time on each core.

    Args:
        cores: what runs the kernels.
    """

    def __init__(self, cores: Cores) -> None:
        self.cores = cores

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        self.cores.each(project, inputs.count, project_arguments(inputs, settings, out))
        return out

    def bin(self, projected: Projected, settings: Settings) -> Lists:
        """Tile lists in order of depth. See `cpu_kernels` for the stages."""
        count = projected.depths.shape[0]
        rows = tile_rows(settings)
        across, down = -(-settings.width // TILE_WIDTH), -(-settings.height // rows)
        tiles, chunks = across * down, self.cores.chunks(count)
        counters, spans_before, slots, tile_counts, histogram = torch.zeros(
            kernels.COUNTERS + chunks + 1 + count + chunks * tiles + kernels.HISTOGRAM,
            dtype=torch.int32,
        ).split([kernels.COUNTERS, chunks + 1, count, chunks * tiles, kernels.HISTOGRAM])
        keys, order, first, offsets, span_counts = torch.empty(
            5 * count + tiles + 1 + chunks, dtype=torch.int32
        ).split([2 * count, 2 * count, count, tiles + 1, chunks])
        records, work, before = flat(projected.records), flat(counters), flat(spans_before)
        order, span_counts, places = flat(order), flat(span_counts), flat(tile_counts)
        self.cores.once(
            kernels.sort_by_depth,
            [records, flat(projected.drawn_depths), count, rows, down, chunks, flat(keys), order,
             flat(histogram), before, work],
        )  # fmt: skip
        spans = flat(torch.empty(3 * int(spans_before[-1]), dtype=torch.int32))
        self.cores.together(
            kernels.count_pairs, chunks,
            [records, order, rows, across, down, settings.width, chunks, before, spans,
             span_counts, places, flat(slots), work],
        )  # fmt: skip
        self.cores.once(
            kernels.place_pairs,
            [tiles, chunks, count, places, flat(offsets), flat(slots), flat(first), work],
        )
        total = int(counters[kernels.N_PAIRS])
        if total < 0:  # it did not fit
            check_addressable(2**31, f"the splats of {count} Gaussians in {tiles} tiles")
        pairs = torch.empty(total, 2, dtype=torch.int32)
        self.cores.together(
            kernels.scatter_pairs, chunks,
            [tiles, chunks, before, spans, span_counts, places, flat(first), flat(pairs), work],
        )  # fmt: skip
        return Lists(rows, across, down, pairs, offsets, first, slots)

    def composite(
        self, inputs: Inputs, settings: Settings, records: Tensor, lists: Lists
    ) -> Images:
        images = Images.empty(inputs, settings)
        arguments = tile_arguments(inputs, settings, records, lists, images)
        self._tiles(kernels.forward_tiles, lists, arguments)
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
        partials = torch.zeros(lists.pairs.shape[0], stride)
        arguments = tile_arguments(inputs, settings, records, lists, images)
        arguments += upstream_arguments(upstream, partials)
        self._tiles(kernels.backward_tiles, lists, arguments)
        out = Gradients(inputs, pose)
        arguments = adjoint_arguments(inputs, settings, records, lists, partials, out)
        self.cores.each(project_adjoint, inputs.count, arguments)
        return out

    def _tiles(self, kernel: Any, lists: Lists, arguments: list[Any]) -> None:
        """Every core takes tile after tile."""
        counters = torch.zeros(kernels.COUNTERS, dtype=torch.int32)
        cores = min(self.cores.number(lists.tiles), self.cores.chunks(4 * lists.pairs.shape[0]))
        self.cores.together(kernel, cores, [flat(counters), lists.tile_rows, *arguments])


def tile_rows(settings: Settings) -> int:
    """Height of a tile: tall ones make fewer pairs, low ones spread better over cores.

    It must not depend on the number of cores, for results do not.
    """
    pixels = settings.width * settings.height
    return 16 if pixels <= 96 * 96 else 32 if pixels <= 160 * 160 else MAX_ROWS
