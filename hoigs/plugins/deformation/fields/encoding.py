"""Encodings of place and time, and the network that reads them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.maths.splines import neighbours
from hoigs.core.values.gaussians import Gaussians


def positional_encoding(
    x: Float[Tensor, "*batch D"], frequencies: int, window: float | None = None
) -> Float[Tensor, "*batch E"]:
    """[x, sin(2^0 x), ..., sin(2^(L-1) x), cos(2^0 x), ...], E = D (1 + 2 L) (D3DGS, time_utils).

    Args:
        window: number of octaves with a weight, from 0 to `frequencies`; the weight of the last is
            between 0 and 1 (Nerfies, Park et al. 2021, arXiv:2011.12948). None is all.
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
    """ReLU layers, of which one takes the input again (NeRF's trunk).

    Args:
        entry: width of the input. width, depth: of the layers.
        skip: index of the layer whose input is [input, hidden]; None for none.
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
    """Maps points to [-1, 1] in the bounding box of the Gaussians at the start.

    Points may leave it later.
    """

    low: Tensor
    high: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("high", torch.ones(3))

    def bind(self, canonical: Gaussians) -> None:
        means = canonical.means.detach()
        if len(means) == 0:
            return
        low, high = means.amin(0), means.amax(0)
        grown = (high - low).clamp_min(1e-3) - (high - low)  # the box of a flat cloud is not flat
        self.low, self.high = low - grown / 2, high + grown / 2

    def forward(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return 2 * (points - self.low) / (self.high - self.low) - 1


class TimeTable(nn.Module):
    """Learned codes at given times, linear between them and constant outside.

    Args:
        size: of each code. times: of the codes, in [0, 1], ascending.
        spread: standard deviation of the codes at the start.

    Raises:
        ValueError: there are no times, or they do not ascend.
    """

    times: Tensor

    def __init__(self, size: int, times: Sequence[float], spread: float = 0.05) -> None:
        super().__init__()
        if not times or list(times) != sorted(times):
            raise ValueError(f"a table needs ascending times, got {list(times)[:5]}")
        self.register_buffer("times", torch.tensor(list(times), dtype=torch.float64))
        self.codes = nn.Parameter(torch.randn(len(times), size) * spread)

    def forward(self, time: float) -> Float[Tensor, " C"]:
        low, high, r = neighbours(time, self.times.tolist())
        return torch.lerp(self.codes[low], self.codes[high], r)
