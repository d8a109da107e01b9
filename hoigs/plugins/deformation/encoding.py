"""Coordinates as networks of this family read them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.gaussians import Gaussians


def positional_encoding(
    x: Float[Tensor, "*batch D"], frequencies: int, window: float | None = None
) -> Float[Tensor, "*batch E"]:
    """[x, sin(2^0 x), ..., sin(2^(L-1) x), cos(2^0 x), ...], E = D (1 + 2 L) (D3DGS, time_utils).

    Args:
        window: octaves that are let in, of 0 to `frequencies`, the last of them in part (Nerfies,
            Park et al. 2021, eq. 13); None lets in all.
    """
    octaves = torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = x[..., None, :] * (2.0**octaves)[:, None]
    waves = torch.stack((angles.sin(), angles.cos()), dim=-3)
    if window is not None:
        weights = (1 - torch.cos(math.pi * (window - octaves).clamp(0, 1))) / 2
        waves = waves * weights[:, None]
    return torch.cat((x, waves.flatten(-3)), dim=-1)


def encoded_width(size: int, frequencies: int) -> int:
    """E of `positional_encoding`."""
    return size * (1 + 2 * frequencies)


class SkipTrunk(nn.Module):
    """ReLU layers that take the input again before one of them (NeRF's trunk).

    Args:
        entry: width of the input. width, depth: of the layers.
        skip: the layer, counted from 0, whose input is [input, hidden]; None for none.
    """

    def __init__(self, entry: int, width: int, depth: int, skip: int | None) -> None:
        super().__init__()
        sizes = [entry] + [width] * (depth - 1)
        if skip is not None and 0 < skip < depth:
            sizes[skip] += entry
        self.skip = skip
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in sizes)

    def forward(self, entry: Float[Tensor, "N E"]) -> Float[Tensor, "N W"]:
        hidden = entry
        for i, layer in enumerate(self.layers):
            if i == self.skip and i > 0:
                hidden = torch.cat((entry, hidden), dim=-1)
            hidden = torch.relu(layer(hidden))
        return hidden


class UnitBox(nn.Module):
    """Points to [-1, 1] in the box of the Gaussians at the start; points may leave it later."""

    low: Tensor
    high: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("high", torch.ones(3))

    def bind(self, rest: Gaussians) -> None:
        means = rest.means.detach()
        if len(means) == 0:
            return
        low, high = means.amin(0), means.amax(0)
        grown = (high - low).clamp_min(1e-3) - (high - low)  # a flat cloud has a box too
        self.low, self.high = low - grown / 2, high + grown / 2

    def forward(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return 2 * (points - self.low) / (self.high - self.low) - 1


class TimeTable(nn.Module):
    """Learned codes at given times, linear in between and held at the ends.

    Args:
        size: of each code. times: in [0, 1], one code each, ascending.
        spread: standard deviation of the codes at the start.
    """

    times: Tensor

    def __init__(self, size: int, times: Sequence[float], spread: float = 0.05) -> None:
        super().__init__()
        if not times or list(times) != sorted(times):
            raise ValueError(f"a table needs ascending times, got {list(times)[:5]}")
        self.register_buffer("times", torch.tensor(list(times), dtype=torch.float64))
        self.codes = nn.Parameter(torch.randn(len(times), size) * spread)

    def forward(self, time: float) -> Float[Tensor, " C"]:
        if len(self.codes) == 1:
            return self.codes[0]
        times = self.times.tolist()
        k = min(max(sum(t <= time for t in times) - 1, 0), len(times) - 2)
        r = (time - times[k]) / max(times[k + 1] - times[k], 1e-9)
        return torch.lerp(self.codes[k], self.codes[k + 1], min(max(r, 0.0), 1.0))
