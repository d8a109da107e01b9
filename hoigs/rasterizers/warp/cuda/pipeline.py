"""The stages of a render on CUDA: one warp for each tile, and no waiting for the device."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.fast.cuda_launch import CudaStreams
from hoigs.rasterizers.warp.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
    tile_arguments,
    upstream_arguments,
)
from hoigs.rasterizers.warp.blend import (
    absolute_kernels,
    gather_kernels,
    pixel_kernels,
    pixel_source,
)
from hoigs.rasterizers.warp.cuda.intersections import IntersectionCapacity, Intersector
from hoigs.rasterizers.warp.frame import (
    Images,
    Inputs,
    Settings,
    TileIntersections,
    check_addressable,
)
from hoigs.rasterizers.warp.intersect import cuda_kernels
from hoigs.rasterizers.warp.project import kernels as pinhole
from hoigs.rasterizers.warp.project import optics
from hoigs.rasterizers.warp.project.spherical_harmonics_adjoint import BLOCK as SH_BLOCK
from hoigs.rasterizers.warp.project.spherical_harmonics_adjoint import harmonics_adjoint
from hoigs.rasterizers.warp.records import ABSOLUTES, MOMENTS

TILE_BLOCK = 32 * pixel_source.WARPS


class CudaPipeline:
    """Renders on one CUDA device, on torch's current stream."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.streams = device.index, CudaStreams()
        self.capacity = IntersectionCapacity(device)
        self._intersector = Intersector(self.streams, self.capacity)

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        arguments = project_arguments(inputs, settings, out)
        kernel = (optics if settings.optics else pinhole).project
        self.streams.current(self.device).each(kernel, inputs.count, arguments)
        return out

    def intersect(self, projected: Projected, settings: Settings) -> TileIntersections:
        return self._intersector.intersect(projected, settings)

    def blend(
        self,
        inputs: Inputs,
        settings: Settings,
        records: Tensor,
        intersections: TileIntersections,
    ) -> Images:
        images = Images.empty(inputs, settings)
        arguments = tile_arguments(inputs, settings, records, intersections, images)
        arguments += [intersections.keys, intersections.owners]
        lanes, stream = intersections.tiles * pixel_source.LANES, self.streams.current(self.device)
        kernel, part = pixel_kernels.forward_pixels, cuda_kernels.ALL
        if intersections.counted is not None:
            stream.each(kernel, lanes, [*arguments, cuda_kernels.NEAR], TILE_BLOCK)
            self._intersector.intersect_others(intersections)
            part = cuda_kernels.OTHERS
        stream.each(kernel, lanes, [*arguments, part], TILE_BLOCK)
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
        stream, count = self.streams.current(self.device), inputs.count
        stride = MOMENTS + inputs.channels + ABSOLUTES * absolute
        capacity, tiles = intersections.count, intersections.tiles
        check_addressable(capacity * stride, f"{capacity} tile intersections")
        # until they are summed, the partials are where the largest of the gradients will be, if
        # they fit there; else their memory is free again before that is allocated
        fit = capacity * stride <= inputs.sh.numel()
        size = inputs.sh.shape if fit else (capacity, stride)
        partials = inputs.means.new_empty(size)
        words = -(-capacity // 16)
        written = partials.new_empty(16 * words, dtype=torch.uint8)
        arguments = [count, stride, tiles, intersections.offsets, written, partials]
        stream.each(gather_kernels.clear_partials, words, arguments)
        arguments = tile_arguments(inputs, settings, records, intersections, images)
        arguments += [*upstream_arguments(upstream, partials), written]
        lanes = tiles * pixel_source.LANES
        kernel = absolute_kernels.absolute_pixels if absolute else pixel_kernels.backward_pixels
        stream.each(kernel, lanes, arguments, TILE_BLOCK)

        # allocated while the device is at the pixels
        out = Gradients(inputs, pose, absolute, offsets, settings.optics)
        drawn = torch.empty_like(intersections.first_partial)
        arguments = [
            *(count, stride, inputs.channels, intersections.first_partial),
            *(intersections.tiles_per_gaussian, written, partials),
            *(out.means, out.quats, out.log_scales, out.features, out.absolutes, drawn),
        ]
        blocks = -(-count // gather_kernels.ROWS)
        stream.blocks(gather_kernels.gather_partials, blocks, gather_kernels.BLOCK, arguments)
        sh = partials if fit else None
        del partials, written, arguments
        out.sh = torch.empty_like(inputs.sh) if sh is None else sh
        bases = inputs.sh.shape[1], settings.active_bases
        if settings.active_bases > 1:  # the adjoint of harmonics is a kernel of its own
            arguments = [
                *(inputs.means, inputs.sh, *bases, inputs.world_to_camera, records, drawn),
                *(out.log_scales, out.sh, count),
            ]
            stream.blocks(harmonics_adjoint, -(-count // SH_BLOCK), SH_BLOCK, arguments)
            bases = 0, 0
        arguments = adjoint_arguments(inputs, settings, bases, records, drawn, None, out)
        stream.each((optics if settings.optics else pinhole).project_adjoint, count, arguments)
        return out
