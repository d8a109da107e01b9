"""Small networks: how their layers start, and chains of layers on CPUs."""

from __future__ import annotations

import functools

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.fast.choose import native

WORTHWHILE = 256  # rows: fewer take as long either way


def zeroed(layer: nn.Linear) -> nn.Linear:
    """`layer` with weights and bias of zero, for a network that starts by changing nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def dense(layers: nn.Sequential, rows: Float[Tensor, "N I"]) -> Float[Tensor, "N O"]:
    """`layers(rows)`, of a chain of Linear and ReLU, by the fastest way for where it is.

    On CPUs with AVX-512 these are the kernels of `cpu_kernels.dense`: they are fused, and torch
    takes MKL for float32, which on processors of AMD has AVX2 only.
    """
    kernels = native("dense", rows) if len(rows) >= WORTHWHILE and _wide_vectors() else None
    linears = [layer for layer in layers if isinstance(layer, nn.Linear)]
    widths = [size for layer in linears for size in (layer.in_features, layer.out_features)]
    if kernels is None or not kernels.fits(*widths):
        result: Tensor = layers(rows)
        return result
    chain = list(layers)
    for layer, after in zip(chain, [*chain[1:], None], strict=True):
        if isinstance(layer, nn.Linear):
            relu = isinstance(after, nn.ReLU)
            rows = kernels.DenseLayer.apply(rows, layer.weight, layer.bias, relu)
        elif not isinstance(layer, nn.ReLU):
            raise TypeError(f"dense: expected Linear and ReLU, got {type(layer).__name__}")
    return rows


@functools.cache
def _wide_vectors() -> bool:
    return torch.backends.cpu.get_cpu_capability() == "AVX512"
