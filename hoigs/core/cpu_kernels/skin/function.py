"""Skinning of points and rotations, and products of quaternions: one kernel for each pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.core.cpu_kernels.skin import kernels
from hoigs.core.cpu_kernels.skin.source import CHUNK, LANES, MAX_JOINTS
from hoigs.core.cpu_kernels.workers import shared
from hoigs.core.first_order import IN_TORCH, first_order


def fits(joints: int) -> bool:
    """Whether the kernels take so many joints."""
    return joints <= MAX_JOINTS


class ComposedQuats(torch.autograd.Function):
    """normalise(offset + first) * normalise(second), of float32 quaternions [N, 4] on a CPU."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, offset: float) -> Tensor:
        first, second = first.contiguous(), second.contiguous()
        ctx.offset = offset
        ctx.save_for_backward(first, second)
        out, nothing = torch.empty_like(first), first.new_empty(0)
        count = len(first)
        arguments = [count, offset, first, second, 0, nothing, out, nothing]
        shared(kernels.compose, -(-count // CHUNK), arguments)
        return out

    @staticmethod
    @first_order("the CPU kernel of skinning", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor, None]:
        first, second = ctx.saved_tensors
        out, to_second, count = torch.empty_like(first), torch.empty_like(second), len(first)
        arguments = [count, ctx.offset, first, second, 1, upstream.contiguous(), out, to_second]
        shared(kernels.compose, -(-count // CHUNK), arguments)
        return out, to_second, None


class SkinnedGaussians(torch.autograd.Function):
    """`skinning.skin_gaussians`, of float32 tensors on a CPU.

    `table` has for each joint three rows of its transform and its quaternion, [J, 16].
    """

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, quats: Tensor, weights: Tensor, table: Tensor
    ) -> tuple[Tensor, Tensor]:
        inputs = [x.contiguous() for x in (points, quats, weights, table)]
        ctx.save_for_backward(*inputs)
        means, turned = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
        count = len(points)
        arguments = [count, len(table), *inputs, means, turned]
        shared(kernels.skin, -(-count // CHUNK), arguments)
        return means, turned

    @staticmethod
    @first_order("the CPU kernel of skinning", IN_TORCH)
    def backward(ctx: Any, to_means: Tensor, to_turned: Tensor) -> tuple[Tensor | None, ...]:
        points, quats, weights, table = ctx.saved_tensors
        *_, with_weights, with_table = ctx.needs_input_grad
        count, joints = weights.shape
        chunks, nothing = -(-count // CHUNK), points.new_empty(0)
        to_points, to_quats = torch.empty_like(points), torch.empty_like(quats)
        to_weights = torch.empty_like(weights) if with_weights else nothing
        sums = points.new_zeros(chunks, joints, LANES) if with_table else nothing
        shared(
            kernels.skin_adjoint, chunks,
            [count, joints, points, quats, weights, table, to_means.contiguous(),
             to_turned.contiguous(), int(with_weights), int(with_table), to_points, to_quats,
             to_weights, sums],
        )  # fmt: skip
        return (
            to_points,
            to_quats,
            to_weights if with_weights else None,
            sums.sum(0) if with_table else None,
        )
