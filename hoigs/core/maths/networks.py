"""Small networks: how their layers start, and chains of layers on CPUs."""

from __future__ import annotations

import functools
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

WORTHWHILE = 256  # rows: fewer take as long either way


def zeroed(layer: nn.Linear) -> nn.Linear:
    """`layer` with weights and bias of zero, for a network that starts by changing nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def dense(layers: nn.Sequential, rows: Float[Tensor, "N I"]) -> Float[Tensor, "N O"]:
    """`layers(rows)`, of a chain of Linear and ReLU, by the fastest way for where it is."""
    if not _by_onednn(rows):
        result: Tensor = layers(rows)
        return result
    chain = list(layers)
    for layer, after in zip(chain, [*chain[1:], None], strict=True):
        if isinstance(layer, nn.Linear):
            relu = isinstance(after, nn.ReLU)
            rows = _OneDNNLayer.apply(rows, layer.weight, layer.bias, relu)
        elif not isinstance(layer, nn.ReLU):
            raise TypeError(f"dense: expected Linear and ReLU, got {type(layer).__name__}")
    return rows


def _by_onednn(rows: Tensor) -> bool:
    return (
        rows.device.type == "cpu"
        and rows.dtype == torch.float32
        and len(rows) >= WORTHWHILE
        and _onednn_has_wider_vectors()
    )


@functools.cache
def _onednn_has_wider_vectors() -> bool:
    """Whether torch's oneDNN multiplies matrices with AVX-512.

    torch takes MKL for float32, which on processors of AMD uses AVX2 only, at less than half of
    oneDNN's speed; on others both are alike. The operation is the one that torch.compile emits.
    """
    return (
        torch.backends.mkldnn.is_available()
        and torch.backends.cpu.get_cpu_capability() == "AVX512"
        and hasattr(torch.ops.mkldnn, "_linear_pointwise")
    )


def _product(rows: Tensor, weight: Tensor, bias: Tensor | None, after: str) -> Tensor:
    result: Tensor = torch.ops.mkldnn._linear_pointwise(rows, weight, bias, after, [], "")
    return result


class _OneDNNLayer(torch.autograd.Function):
    """x W^T + b, and then ReLU."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
        result = _product(rows, weight, bias, "relu" if relu else "none")
        ctx.relu = relu
        ctx.save_for_backward(rows, weight, result if relu else None)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, result = ctx.saved_tensors
        with_rows, with_weight, with_bias, _ = ctx.needs_input_grad
        if ctx.relu:
            upstream = torch.ops.aten.threshold_backward(upstream, result, 0)
        return (
            _product(upstream, weight.t(), None, "none") if with_rows else None,
            _product(upstream.t(), rows.t(), None, "none") if with_weight else None,
            upstream.sum(0) if with_bias else None,
            None,
        )
