"""A layer of a network, relu(x W^T + b): one kernel forward and one backward."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from hoigs.core.cpu_kernels.dense import kernels
from hoigs.core.cpu_kernels.dense.source import CHUNK, FORWARD_CHUNK, HIGH, LANES, MAX_WIDTH
from hoigs.core.cpu_kernels.workers import shared
from hoigs.core.first_order import IN_TORCH, first_order


def fits(*widths: int) -> bool:
    """Whether the kernels take layers of these widths."""
    return max(widths) <= MAX_WIDTH


def whole_vectors(width: int) -> tuple[int, int]:
    """Columns of a matrix up to whole vectors, and a distance between its rows.

    An odd number of vectors, so that the rows of a tile do not share a few sets of the cache.
    """
    padded = width + -width % LANES
    return padded, padded + LANES * (padded // LANES % 2 == 0)


class DenseLayer(torch.autograd.Function):
    """`relu(rows @ weight.T + bias)`, or without ReLU, of float32 tensors on a CPU.

    There are at least HIGH rows.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
        rows = rows.contiguous()
        (count, entry), width = rows.shape, len(weight)
        padded, stride = whole_vectors(width)
        ctx.relu = int(relu)
        out = rows.new_empty(count, width)
        shift = rows.new_zeros(padded) if bias is None else pad(bias, (0, padded - width))
        shared(
            kernels.layer,
            -(-count // FORWARD_CHUNK),
            [count, entry, width, padded, stride, ctx.relu, rows,
             pad(weight.t(), (0, stride - width)), shift, out],
        )  # fmt: skip
        ctx.save_for_backward(rows, weight, out if relu else None)
        return out

    @staticmethod
    @first_order("the CPU kernel of dense layers", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, result = ctx.saved_tensors
        (count, entry), width = rows.shape, len(weight)
        with_rows, with_weight, with_bias, _ = ctx.needs_input_grad
        padded, stride = whole_vectors(entry)
        high, wide, chunks = width + -width % HIGH, width + -width % LANES, -(-count // CHUNK)
        nothing = rows.new_empty(0)
        to_rows = torch.empty_like(rows) if with_rows else nothing
        summed = with_weight or with_bias
        sums = rows.new_zeros(chunks, high * padded + wide) if summed else nothing
        shared(
            kernels.layer_adjoint,
            chunks,
            [count, entry, width, padded, stride, ctx.relu, rows,
             pad(weight, (0, stride - entry)), result if ctx.relu else nothing,
             upstream.contiguous(), int(with_rows), int(summed), to_rows, sums],
        )  # fmt: skip
        whole = sums.sum(0) if summed else nothing
        matrix, rest = whole[: high * padded], whole[high * padded :]
        return (
            to_rows if with_rows else None,
            matrix.view(high, padded)[:width, :entry].contiguous() if with_weight else None,
            rest[:width].clone() if with_bias else None,
            None,
        )
