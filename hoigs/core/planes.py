"""Feature planes over space and time (HexPlane, Cao & Johnson 2023; HOIGS, Sec. "Human";
K-Planes, Fridovich-Keil et al. 2023; 4DGS, Wu et al. 2024).

Points are addressed in [-1, 1] per axis, border cells reaching to the edge (align_corners) and
values held outside. Planes are stored channels last, so that one row is one cell's features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.clock import Time, constant, filled

# Axes (0 x, 1 y, 2 z) of the space planes xy, xz, yz, and the axis that each time plane pairs
# with time so that the product of the two sees all four coordinates: xy*zt, xz*yt, yz*xt
SPACE_AXES = ((0, 1), (0, 2), (1, 2))
TIME_AXES = (2, 1, 0)


def sample_planes(
    planes: Float[Tensor, "P H W C"], points: Float[Tensor, "P N 2"]
) -> Float[Tensor, "N F"]:
    """Bilinear features of N points on each of P planes, concatenated: F = P * C.

    Args:
        points: in [-1, 1]; first coordinate along W, second along H; outside is held.
    """
    count, height, width, channels = planes.shape
    size = constant((width - 1, height - 1), points)
    cell = ((points + 1) / 2).clamp(0, 1) * size
    corner = torch.minimum(cell.detach().floor(), size - 1).clamp_min(0)
    fx, fy = (cell - corner).unbind(-1)
    x, y = corner.long().unbind(-1)
    offset = constant(tuple((i * height * width,) for i in range(count)), points, torch.long)
    # on a plane of one cell across, the neighbour is the cell itself
    right, below = min(1, width - 1), min(1, height - 1) * width
    first = offset + y * width + x
    rows = first[..., None] + constant((0, right, below, below + right), first)
    across, down = torch.stack((1 - fx, fx), -1), torch.stack((1 - fy, fy), -1)
    weights = (down[..., :, None] * across[..., None, :]).flatten(-2)
    # one gather of four contiguous rows a point: on CPUs half the time of grid_sample
    sampled = nn.functional.embedding_bag(
        rows.flatten(0, 1),
        planes.reshape(-1, channels),
        per_sample_weights=weights.flatten(0, 1),
        mode="sum",
    )
    return sampled.unflatten(0, (count, -1)).transpose(0, 1).flatten(1)


def axis_pairs(
    points: Float[Tensor, "N 3"], axes: tuple[tuple[int, int], ...] = SPACE_AXES
) -> Float[Tensor, "P N 2"]:
    """Two coordinates of each point for each plane."""
    flat = constant(tuple(axis for pair in axes for axis in pair), points, torch.long)
    return points.index_select(1, flat).unflatten(1, (len(axes), 2)).transpose(0, 1)


def timed_pairs(
    points: Float[Tensor, "N 3"], clock: Time, axes: tuple[int, ...]
) -> Float[Tensor, "P N 2"]:
    """A coordinate of each point for each plane, and a time in [-1, 1] beside it."""
    chosen = points.index_select(1, constant(axes, points, torch.long)).T
    return torch.stack((chosen, filled(points, tuple(chosen.shape), clock)), -1)


def roughness(planes: Float[Tensor, "P H W C"]) -> Float[Tensor, ""]:
    """Mean squared second difference along H, 0 with fewer than three rows (4DGS; K-Planes)."""
    if planes.shape[1] < 3:
        return planes.new_zeros(())
    first = planes[:, 1:] - planes[:, :-1]
    return (first[:, 1:] - first[:, :-1]).square().mean()


class PairedPlanes(nn.Module):
    """Three space planes and, paired with them, three space-time planes.

    f(x, y, z) concatenates the space planes; phi(x, y, z, t) multiplies each with its partner
    first. Both are 3 * channels wide. Time planes start at one, so that phi = f at the start.

    Args:
        channels: of each plane; 32 gives the paper's 96.
        resolution: cells along each space axis. time_resolution: along time; 0 is no time planes,
            as if all were one: phi = f.
        spread: standard deviation of the space planes at the start.
    """

    time: nn.Parameter | None

    def __init__(
        self,
        channels: int = 32,
        resolution: int = 128,
        time_resolution: int = 32,
        spread: float = 0.1,
    ) -> None:
        super().__init__()
        self.width = 3 * channels
        self.space = nn.Parameter(torch.randn(3, resolution, resolution, channels) * spread)
        timed = torch.ones(3, time_resolution, resolution, channels)
        self.register_parameter("time", nn.Parameter(timed) if time_resolution else None)

    def forward(
        self, points: Float[Tensor, "N 3"], time: Time | None = None
    ) -> Float[Tensor, "N F"]:
        """f at points in [-1, 1], or phi when a time in [0, 1] is given."""
        features = sample_planes(self.space, axis_pairs(points))
        if time is None or self.time is None:
            return features
        pairs = timed_pairs(points, 2 * time - 1, TIME_AXES)
        return features * sample_planes(self.time, pairs)

    def time_smoothness(self) -> Float[Tensor, ""]:
        """Mean squared second difference of the time planes along time (4DGS)."""
        return self.space.new_zeros(()) if self.time is None else roughness(self.time)

    def time_sparsity(self) -> Float[Tensor, ""]:
        """Mean distance of the time planes from one (4DGS): no motion where none is needed."""
        return self.space.new_zeros(()) if self.time is None else (self.time - 1).abs().mean()


class ProductPlanes(nn.Module):
    """Six planes xy, xz, yz, xt, yt, zt multiplied, several resolutions concatenated (4DGS).

    Args:
        channels: of each plane. resolution: cells along each space axis at the first scale.
        time_resolution: along time, at every scale; 0 is no time planes, as if all were one.
        scales: multiples of `resolution`; time keeps its own.
        spread: bounds of the uniform values at the start of space planes; time planes are one.
    """

    def __init__(
        self,
        channels: int = 16,
        resolution: int = 64,
        time_resolution: int = 150,
        scales: Sequence[int] = (1, 2, 4),
        spread: tuple[float, float] = (0.1, 0.5),
    ) -> None:
        super().__init__()
        self.width = channels * len(scales)
        sizes = [resolution * scale for scale in scales]
        self.space = nn.ParameterList(
            torch.empty(3, size, size, channels).uniform_(*spread) for size in sizes
        )
        self.time = nn.ParameterList(
            torch.ones(3, time_resolution, size, channels) for size in sizes if time_resolution
        )

    def forward(self, points: Float[Tensor, "N 3"], clock: Time) -> Float[Tensor, "N F"]:
        """Features at points in [-1, 1] and a time in [-1, 1], both held outside."""
        pairs, timed = axis_pairs(points), timed_pairs(points, clock, (0, 1, 2))
        scales = []
        for scale, space in enumerate(self.space):
            planes = sample_planes(space, pairs)
            if len(self.time):
                planes = torch.cat((planes, sample_planes(self.time[scale], timed)), 1)
            scales.append(planes.unflatten(1, (3 + 3 * bool(len(self.time)), -1)).prod(1))
        return torch.cat(scales, dim=1)

    def smoothness(self) -> dict[str, Float[Tensor, ""]]:
        """4DGS's three penalties, each summed over planes and scales.

        "plane_tv": `roughness` of the space planes, along one axis and of second order for all its
        name. "time_smoothness": of the time planes along time. "l1_time_planes": their mean
        distance from one.
        """
        sums = {
            "plane_tv": [roughness(planes) for planes in self.space],
            "time_smoothness": [roughness(planes) for planes in self.time],
            "l1_time_planes": [(planes - 1).abs().mean() for planes in self.time],
        }
        return {name: 3 * torch.stack(terms).sum() for name, terms in sums.items() if terms}
