"""Feature planes over space and time: f(x, y, z) and phi(x, y, z, t) of HOIGS, Eq. 5 and 7.

Two ways of combining six planes are here, that of HexPlane (Cao and Johnson 2023, arXiv:2301.09632)
and that of K-Planes (Fridovich-Keil et al. 2023, arXiv:2301.10241) and 4DGS (Wu et al. 2024,
arXiv:2310.08528). Points are in [-1, 1] on each axis; border cells reach to the edge
(align_corners), and outside the border value is used. Planes are stored channels last, so that one
row holds the features of one cell.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.device import Time, filled, replaceable
from hoigs.core.parameters import OverTime

# Axes (0 x, 1 y, 2 z) of the space planes xy, xz, yz, and the axis that each time plane pairs
# with time so that the product of the two sees all four coordinates: xy*zt, xz*yt, yz*xt
SPACE_AXES = ((0, 1), (0, 2), (1, 2))
TIME_AXES = (2, 1, 0)


@replaceable
def sample_planes(
    planes: Float[Tensor, "P H W C"], points: Float[Tensor, "P N 2"]
) -> Float[Tensor, "N F"]:
    """Bilinear features of N points on each of P planes, concatenated: F = P * C.

    Args:
        points: in [-1, 1]; first coordinate along W, second along H.
    """
    count, height, width, channels = planes.shape
    u, v = ((points + 1) / 2).clamp(0, 1).unbind(-1)
    x, y = u * (width - 1), v * (height - 1)  # in cells
    left = x.detach().floor().clamp(max=width - 2).clamp_min(0)
    top = y.detach().floor().clamp(max=height - 2).clamp_min(0)
    fx, fy = x - left, y - top
    # on a plane that is one cell wide or high, the neighbour is the cell itself
    right, below = min(1, width - 1), min(1, height - 1) * width
    plane = torch.arange(count, device=points.device)[:, None] * (height * width)
    cell = plane + top.long() * width + left.long()
    cells = torch.stack((cell, cell + right, cell + below, cell + below + right), -1)
    weights = torch.stack(((1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx), -1)
    # gathering four contiguous rows per point: less to read than grid_sample's channels apart
    sampled = nn.functional.embedding_bag(
        cells.flatten(0, 1),
        planes.reshape(-1, channels),
        per_sample_weights=weights.flatten(0, 1),
        mode="sum",
    )
    return sampled.unflatten(0, (count, -1)).transpose(0, 1).flatten(1)


def axis_pairs(points: Float[Tensor, "N 3"]) -> Float[Tensor, "3 N 2"]:
    """Two coordinates of each point for each space plane."""
    xyz = points.unbind(1)
    chosen = torch.stack([xyz[axis] for pair in SPACE_AXES for axis in pair])
    return chosen.unflatten(0, (len(SPACE_AXES), 2)).mT


def timed_pairs(
    points: Float[Tensor, "N 3"], time: Time, axes: tuple[int, ...]
) -> Float[Tensor, "P N 2"]:
    """One coordinate of each point for each plane, paired with a time in [0, 1] as 2 t - 1."""
    xyz = points.unbind(1)
    chosen = torch.stack([xyz[axis] for axis in axes])
    return torch.stack((chosen, filled(points, tuple(chosen.shape), 2 * time - 1)), -1)


def roughness(values: Float[Tensor, "*shape"], dim: int = 1) -> Float[Tensor, ""]:
    """Mean squared second difference along an axis (K-Planes; 4DGS); 0 with fewer than three rows.

    For planes [P, H, W, C] axis 1 is H: time in a time plane.
    """
    if values.shape[dim] < 3:
        return values.new_zeros(())
    return values.diff(dim=dim).diff(dim=dim).square().mean()


class PairedPlanes(OverTime):
    """Three space planes, each multiplied with the time plane of the third axis (HexPlane).

    f(x, y, z) concatenates the space planes; phi(x, y, z, t) multiplies each with its time plane
    first. Both are 3 * channels wide. Time planes start at one, so that phi = f at the start.

    Args:
        channels: channels of each plane; 32 gives the paper's 96.
        resolution: cells along each space axis. time_resolution: along time; 0 leaves the time
            planes out: phi = f.
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
        self.keep_rows(time_resolution, *(["time"] if time_resolution else []))

    def forward(
        self, points: Float[Tensor, "N 3"], time: Time | None = None
    ) -> Float[Tensor, "N F"]:
        """f at points in [-1, 1], or phi when a time in [0, 1] is given."""
        features = sample_planes(self.space, axis_pairs(points))
        if time is None or self.time is None:
            return features
        time = self.rows.local(time, self.time.shape[1])
        return features * sample_planes(self.time, timed_pairs(points, time, TIME_AXES))

    def time_smoothness(self) -> Float[Tensor, ""]:
        """`roughness` of the time planes along time."""
        return self.space.new_zeros(()) if self.time is None else roughness(self.time)

    def time_sparsity(self) -> Float[Tensor, ""]:
        """Mean distance of the time planes from one, which is no motion (4DGS)."""
        return self.space.new_zeros(()) if self.time is None else (self.time - 1).abs().mean()


class ProductPlanes(OverTime):
    """Six planes xy, xz, yz, xt, yt, zt multiplied, several resolutions concatenated (K-Planes).

    f(x, y, z) is the product of the space planes alone; phi(x, y, z, t) multiplies in the time
    planes. Time planes start at one, so that phi = f at the start.

    Args:
        channels: of each plane.
        resolutions: cells along each space axis, one for each scale; time keeps its own.
        time_resolution: cells along time, at every scale; 0 leaves the time planes out: phi = f.
        spread: bounds of the uniform values of the space planes at the start.
    """

    def __init__(
        self,
        channels: int = 16,
        resolutions: Sequence[int] = (64, 128, 256),
        time_resolution: int = 150,
        spread: tuple[float, float] = (0.1, 0.5),
    ) -> None:
        super().__init__()
        self.width = channels * len(resolutions)
        self.space = nn.ParameterList(
            torch.empty(3, size, size, channels).uniform_(*spread) for size in resolutions
        )
        self.time = nn.ParameterList(
            torch.ones(3, time_resolution, size, channels)
            for size in resolutions
            if time_resolution
        )
        self.keep_rows(time_resolution, *(f"time.{i}" for i in range(len(self.time))))

    def forward(
        self, points: Float[Tensor, "N 3"], time: Time | None = None
    ) -> Float[Tensor, "N F"]:
        """f at points in [-1, 1], or phi when a time in [0, 1] is given."""
        pairs = axis_pairs(points)
        features = [_product(planes, pairs) for planes in self.space]
        if time is not None and len(self.time):
            time = self.rows.local(time, self.time[0].shape[1])
            pairs = timed_pairs(points, time, (0, 1, 2))
            timed = [_product(planes, pairs) for planes in self.time]
            features = [f * t for f, t in zip(features, timed, strict=True)]
        return torch.cat(features, dim=1)

    def space_smoothness(self) -> Float[Tensor, ""]:
        """`roughness` of the space planes along one of their axes (4DGS), mean over scales."""
        return self._mean(roughness(planes) for planes in self.space)

    def time_smoothness(self) -> Float[Tensor, ""]:
        """`roughness` of the time planes along time, mean over scales."""
        return self._mean(roughness(planes) for planes in self.time)

    def time_sparsity(self) -> Float[Tensor, ""]:
        """Mean distance of the time planes from one, mean over scales."""
        return self._mean((planes - 1).abs().mean() for planes in self.time)

    def _mean(self, terms: Iterable[Tensor]) -> Float[Tensor, ""]:
        found = list(terms)
        return torch.stack(found).mean() if found else self.space[0].new_zeros(())


def _product(
    planes: Float[Tensor, "P H W C"], points: Float[Tensor, "P N 2"]
) -> Float[Tensor, "N C"]:
    # not `prod`: its gradient waits for the device to report whether there are zeros
    return functools.reduce(torch.mul, sample_planes(planes, points).chunk(len(planes), 1))
