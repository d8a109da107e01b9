"""Small networks: how their layers start, and chains of layers."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.device import replaceable


def zeroed(layer: nn.Linear) -> nn.Linear:
    """`layer` with weights and bias of zero, for a network that starts by changing nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


@replaceable
def dense(layers: nn.Sequential, rows: Float[Tensor, "N I"]) -> Float[Tensor, "N O"]:
    """`layers(rows)`, of a chain of Linear and ReLU."""
    result: Tensor = layers(rows)
    return result
