"""The stages that the native and the portable CPU kernels have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from torch import Tensor

from hoigs.rasterizers.warp.blend.arguments import tile_arguments, upstream_arguments
from hoigs.rasterizers.warp.common.frame import (
    Images,
    Inputs,
    Settings,
    TileIntersections,
    check_addressable,
)
from hoigs.rasterizers.warp.common.records import ABSOLUTES, MOMENTS
from hoigs.rasterizers.warp.cpu.cores import Cores
from hoigs.rasterizers.warp.project.arguments import (
    Gradients,
    Projected,
    adjoint_arguments,
    project_arguments,
)
from hoigs.rasterizers.warp.project.kernels import project, project_adjoint


class CpuPipeline(ABC):
    """Renders on the CPU.

    Args:
        cores: what runs the kernels.
    """

    forward_kernel: ClassVar[Any]
    backward_kernel: ClassVar[Any]
    absolute_kernel: ClassVar[Any]  # backward, with absolute gradients

    def __init__(self, cores: Cores) -> None:
        self.cores = cores

    def project(self, inputs: Inputs, settings: Settings) -> Projected:
        out = Projected(inputs.means, inputs.count)
        self.cores.each(project, inputs.count, project_arguments(inputs, settings, out))
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
    ) -> Gradients:
        count, stride = intersections.count, MOMENTS + inputs.channels + ABSOLUTES * absolute
        check_addressable(count * stride, f"{count} tile intersections")
        partials = inputs.means.new_zeros(count, stride)
        arguments = tile_arguments(inputs, settings, records, intersections, images)
        arguments += upstream_arguments(upstream, partials)
        kernel = self.absolute_kernel if absolute else self.backward_kernel
        self._tiles(kernel, intersections, arguments)
        out = Gradients(inputs, pose, absolute)
        arguments = adjoint_arguments(inputs, settings, records, intersections, partials, out)
        self.cores.each(project_adjoint, inputs.count, arguments)
        return out

    @abstractmethod
    def _tiles(self, kernel: Any, intersections: TileIntersections, arguments: list[Any]) -> None:
        """Run a kernel for all tiles."""
