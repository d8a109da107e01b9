"""Bilinear samples of feature planes: one kernel forward and one backward."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.core.cpu_kernels.planes import kernels
from hoigs.core.cpu_kernels.planes.source import CHUNK
from hoigs.core.cpu_kernels.workers import shared
from hoigs.core.first_order import IN_TORCH, first_order


class SampledPlanes(torch.autograd.Function):
    """`feature_planes.sample_planes`, of float32 tensors on a CPU."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, points: Tensor) -> Tensor:
        planes, points = planes.contiguous(), points.contiguous()
        many, height, width, channels = planes.shape
        count = points.shape[1]
        ctx.sizes = [count, many, height, width, channels]
        ctx.save_for_backward(planes, points)
        out = planes.new_empty(count, many * channels)
        shared(kernels.sample, -(-count // CHUNK), [*ctx.sizes, planes, points, out])
        return out

    @staticmethod
    @first_order("the CPU kernel of feature planes", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        planes, points = ctx.saved_tensors
        with_planes, with_points = ctx.needs_input_grad
        to_planes = torch.empty_like(planes) if with_planes else planes.new_empty(0)
        to_points = torch.empty_like(points) if with_points else planes.new_empty(0)
        shared(
            kernels.sample_adjoint,
            -(-len(upstream) // CHUNK),
            [*ctx.sizes, planes, points, upstream.contiguous(), int(with_planes),
             int(with_points), to_planes, to_points],
        )  # fmt: skip
        return to_planes if with_planes else None, to_points if with_points else None
