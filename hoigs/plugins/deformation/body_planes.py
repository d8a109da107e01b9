"""A human's feature planes, in two readings (methods A.4), and where on the body they are read."""

from __future__ import annotations

import functools
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.body import PART_NAMES
from hoigs.core.clock import Time
from hoigs.core.planes import PairedPlanes, axis_pairs, sample_planes, timed_pairs

Fusion = Literal["paired", "product"]

FRACTIONS = (4, 2, 1)  # of the finest resolution: three scales of 32 channels are 96 again


class ScaledProductPlanes(nn.Module):
    """Six planes multiplied with each other, three resolutions concatenated (K-Planes, 4DGS).

    f(x, y, z) is the product of the space planes alone; phi(x, y, z, t) multiplies in the planes
    xt, yt, zt. Both are 3 * channels wide. Time planes start at one, so that phi = f at the start.

    Args:
        channels: of each plane. resolution: cells along each space axis of the finest scale.
        time_resolution: along time, at every scale; 0 is no time planes, as if all were one.
    """

    def __init__(self, channels: int, resolution: int, time_resolution: int) -> None:
        super().__init__()
        self.width = len(FRACTIONS) * channels
        sizes = [max(2, resolution // fraction) for fraction in FRACTIONS]
        # a product of three values about 0.45 has the spread of the paired planes' single ones
        self.space = nn.ParameterList(
            torch.empty(3, size, size, channels).uniform_(0.1, 0.8) for size in sizes
        )
        self.time = nn.ParameterList(
            torch.ones(3, time_resolution, size, channels) for size in sizes if time_resolution
        )

    def forward(
        self, points: Float[Tensor, "N 3"], time: Time | None = None
    ) -> Float[Tensor, "N F"]:
        """f at points in [-1, 1], or phi when a time in [0, 1] is given."""
        pairs = axis_pairs(points)
        features = [_product(space, pairs) for space in self.space]
        if time is not None and len(self.time):
            pairs = timed_pairs(points, 2 * time - 1, (0, 1, 2))
            timed = [_product(planes, pairs) for planes in self.time]
            features = [f * t for f, t in zip(features, timed, strict=True)]
        return torch.cat(features, dim=1)

    def time_smoothness(self) -> Float[Tensor, ""]:
        """Mean squared second difference of the time planes along time, mean over scales."""
        bends = [p[:, 2:] - 2 * p[:, 1:-1] + p[:, :-2] for p in self.time]
        if not bends or bends[0].numel() == 0:
            return self.space[0].new_zeros(())
        return torch.stack([b.square().mean() for b in bends]).mean()

    def time_sparsity(self) -> Float[Tensor, ""]:
        """Mean distance of the time planes from one, mean over scales."""
        if not len(self.time):
            return self.space[0].new_zeros(())
        return torch.stack([(p - 1).abs().mean() for p in self.time]).mean()


def _product(
    planes: Float[Tensor, "P H W C"], points: Float[Tensor, "P N 2"]
) -> Float[Tensor, "N C"]:
    # not `prod`, whose gradient asks a device whether there are zeros
    return functools.reduce(torch.mul, sample_planes(planes, points).chunk(len(planes), 1))


def body_planes(
    fusion: Fusion, channels: int, resolution: int, time_resolution: int
) -> PairedPlanes | ScaledProductPlanes:
    """The planes of a human, by reading: see HexPlaneSkinningConfig.fusion."""
    if fusion == "paired":
        return PairedPlanes(channels, resolution, time_resolution)
    return ScaledProductPlanes(channels, resolution, time_resolution)


def field_subset(vertex_parts: Int[Tensor, " V"], count: int) -> Int[Tensor, " S"]:
    """About `count` vertices, equally many of each of the 16 parts, evenly over its indices.

    Raises:
        ValueError: a part without vertices; the human would lack a token.
    """
    chosen = []
    for part, name in enumerate(PART_NAMES):
        rows = (vertex_parts == part).nonzero().squeeze(1)
        if len(rows) == 0:
            raise ValueError(f"the body has no vertex of part {part} ({name})")
        wanted = min(len(rows), -(-count // len(PART_NAMES)))
        picks = torch.linspace(0, len(rows) - 1, wanted, device=rows.device).round().long()
        chosen.append(rows[picks])
    return torch.cat(chosen)
