"""The path of CUDA: lists made on the device, one warp a tile, no waiting for the host."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.rasterizers.warp import pixel_kernels, pixel_source
from hoigs.rasterizers.warp.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
    tile_arguments,
    upstream_arguments,
)
from hoigs.rasterizers.warp.cuda_calls import CudaStream
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings, check_addressable
from hoigs.rasterizers.warp.list_kernels import clear_partials
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
        self.stream = CudaStream()
        self.lists = ListMaker(self.stream, device)

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        self.stream.each(project, inputs.count, project_arguments(inputs, settings, out, as_it_is))
        return out

    def bin(self, projected: Projected, settings: Settings) -> Lists:
        return self.lists.make(projected, settings)

    def composite(
        self, inputs: Inputs, settings: Settings, records: Tensor, lists: Lists
    ) -> Images:
        images = Images.empty(inputs, settings)
        arguments = tile_arguments(inputs, settings, records, lists, images, as_it_is)
        self.stream.each(
            pixel_kernels.forward_pixels, lists.tiles * pixel_source.LANES, arguments, TILE_BLOCK
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
        room = lists.pairs.shape[0]
        check_addressable(room * stride, f"{room} splats in tiles")
        partials = inputs.means.new_empty(room, stride)
        self.stream.each(
            clear_partials, inputs.count, [lists.tiles, stride, lists.offsets, partials]
        )
        arguments = tile_arguments(inputs, settings, records, lists, images, as_it_is)
        arguments += upstream_arguments(upstream, partials, as_it_is)
        self.stream.each(
            pixel_kernels.backward_pixels, lists.tiles * pixel_source.LANES, arguments, TILE_BLOCK
        )
        out = Gradients(inputs, pose)
        arguments = adjoint_arguments(inputs, settings, records, lists, partials, out, as_it_is)
        self.stream.each(project_adjoint, inputs.count, arguments)
        return out
