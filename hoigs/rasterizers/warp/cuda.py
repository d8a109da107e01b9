"""The path of CUDA: lists made on the device, one warp a tile, no waiting for the host."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from hoigs.rasterizers.warp import gather_kernels, pixel_kernels, pixel_source
from hoigs.rasterizers.warp.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
    tile_arguments,
    upstream_arguments,
)
from hoigs.rasterizers.warp.cuda_calls import CudaStreams
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings, check_addressable
from hoigs.rasterizers.warp.harmonics_kernels import BLOCK as ROW_BLOCK
from hoigs.rasterizers.warp.harmonics_kernels import harmonics_adjoint
from hoigs.rasterizers.warp.lists import ListMaker
from hoigs.rasterizers.warp.projection import project, project_adjoint
from hoigs.rasterizers.warp.records import MOMENTS

TILE_BLOCK = 32 * pixel_source.WARPS


def as_it_is(tensor: Tensor, size: int = 1) -> Tensor:
    """CUDA's launches take tensors (see `cuda_calls`)."""
    return tensor


class CudaPath:
    """Renders on one CUDA device, on torch's current stream.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self.streams = CudaStreams()
        self.lists = ListMaker(self.streams, device)

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        arguments = project_arguments(inputs, settings, out, as_it_is)
        self.streams.current().each(project, inputs.count, arguments)
        return out

    def bin(self, projected: Projected, settings: Settings) -> Lists:
        return self.lists.make(projected, settings)

    def composite(
        self, inputs: Inputs, settings: Settings, records: Tensor, lists: Lists
    ) -> Images:
        images = Images.empty(inputs, settings)
        arguments = tile_arguments(inputs, settings, records, lists, images, as_it_is)
        lanes = lists.tiles * pixel_source.LANES
        self.streams.current().each(pixel_kernels.forward_pixels, lanes, arguments, TILE_BLOCK)
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
        stream, count, stride = self.streams.current(), inputs.count, MOMENTS + inputs.channels
        room = lists.pairs.shape[0]
        check_addressable(room * stride, f"{room} splats in tiles")
        partials = inputs.means.new_empty(room, stride)
        arguments = [lists.tiles, stride, lists.offsets, partials]
        stream.each(gather_kernels.clear_partials, count, arguments)
        arguments = tile_arguments(inputs, settings, records, lists, images, as_it_is)
        arguments += upstream_arguments(upstream, partials, as_it_is)
        lanes = lists.tiles * pixel_source.LANES
        stream.each(pixel_kernels.backward_pixels, lanes, arguments, TILE_BLOCK)

        drawn = torch.empty_like(lists.slots)
        arguments = [count, stride, lists.first, lists.slots, partials, drawn]
        blocks = -(-count // gather_kernels.ROWS)
        stream.blocks(gather_kernels.gather_partials, blocks, gather_kernels.BLOCK, arguments)
        lists = replace(lists, slots=drawn)
        out = Gradients(inputs, pose)
        if settings.bands == 1:
            arguments = adjoint_arguments(inputs, settings, records, lists, partials, out, as_it_is)
            stream.each(project_adjoint, count, arguments)
            return out
        without_sh = replace(inputs, sh=inputs.sh[:, :0]), replace(settings, bands=0)
        arguments = adjoint_arguments(*without_sh, records, lists, partials, out, as_it_is)
        stream.each(project_adjoint, count, arguments)
        stream.blocks(
            harmonics_adjoint,
            -(-count // ROW_BLOCK),
            ROW_BLOCK,
            [
                inputs.means,
                inputs.sh,
                inputs.sh.shape[1],
                settings.bands,
                inputs.view,
                records,
                lists.first,
                drawn,
                partials,
                stride,
                out.sh,
                out.means,
                out.pose,
                int(pose),
                count,
            ],
        )
        return out
