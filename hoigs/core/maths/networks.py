"""How layers of small networks start."""

from __future__ import annotations

from torch import nn


def zeroed(layer: nn.Linear) -> nn.Linear:
    """`layer` with weights and bias of zero, for a network that starts by changing nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
