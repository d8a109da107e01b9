"""The roughness of values over neighbours: one kernel for each pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.core.cpu_kernels.roughness import kernels
from hoigs.core.cpu_kernels.workers import shared
from hoigs.core.first_order import IN_TORCH, first_order


class Roughness(torch.autograd.Function):
    """Mean over rows of |x_i - mean of its neighbours' x|^2, of float32 rows on a CPU."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, neighbours: Tensor) -> Tensor:
        values, neighbours = values.contiguous(), neighbours.contiguous()
        apart, total = torch.empty_like(values), values.new_empty(1, dtype=torch.float64)
        sizes = [*values.shape, neighbours.shape[1]]
        shared(kernels.apart_from_neighbours, 1, [*sizes, values, neighbours, apart, total])
        ctx.save_for_backward(apart, neighbours)
        return (total[0] / len(values)).to(values.dtype)

    @staticmethod
    @first_order("the CPU kernel of roughness", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        apart, neighbours = ctx.saved_tensors
        gradient, scale = torch.zeros_like(apart), (2 / len(apart) * upstream).view(1)
        sizes = [*apart.shape, neighbours.shape[1]]
        shared(kernels.apart_adjoint, 1, [*sizes, apart, neighbours, scale, gradient])
        return gradient, None
