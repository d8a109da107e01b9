"""Per-Gaussian uniform cubic B-splines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Self

import torch
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.clip import ObjectTrack
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.topology import TopologyChange


class UniformBSplineConfig(ComponentConfig):
    """Attributes: step: frames between two control points."""

    step: int = Field(4, ge=1)


def basis(u: float) -> tuple[float, float, float, float]:
    """Weights of the four control points about a segment, at u in [0, 1]."""
    return (
        (1 - u) ** 3 / 6,
        (3 * u**3 - 6 * u**2 + 4) / 6,
        (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6,
        u**3 / 6,
    )


def basis_derivative(u: float) -> tuple[float, float, float, float]:
    return -((1 - u) ** 2) / 2, (3 * u**2 - 4 * u) / 2, (-3 * u**2 + 2 * u + 1) / 2, u**2 / 2


class UniformBSpline(DeformationModel):
    """Means on a B-spline; all else as at rest.

    Args:
        control_points: K >= 4, that is K - 3 segments.
        track: where the object starts; without one every control point is at rest.
    """

    provides = frozenset({"velocity"})  # so that features:spline-motion can describe it
    owns = frozenset({"means"})
    per_gaussian = ("control",)
    rates: ClassVar[Mapping[str, str]] = {"control": "keyframes"}

    def __init__(self, control_points: int, *, track: ObjectTrack | None = None) -> None:
        super().__init__()
        if control_points < 4:
            raise ValueError(f"a cubic B-spline needs 4 control points, got {control_points}")
        self.segments, self.track = control_points - 3, track
        self.rest_space = "world" if track is None else "canonical"

    @classmethod
    def from_config(cls, config: UniformBSplineConfig, context: BuildContext) -> Self:
        if context.clip is None:
            raise ValueError("deformation:b-spline needs a clip, for its number of frames")
        segments = max(1, round((context.clip.num_frames - 1) / config.step))
        return cls(segments + 3, track=context.object_track)

    def bind(self, rest: Gaussians) -> None:
        means = rest.means.detach()
        placed = [self._start(means, (i - 1) / self.segments) for i in range(self.segments + 3)]
        self.control = nn.Parameter(torch.stack(placed, dim=1))

    def _start(self, means: Tensor, time: float) -> Tensor:
        if self.track is None:
            return means
        last = len(self.track.translations) - 1
        frame = round(min(max(time, 0.0), 1.0) * last)
        return means @ self.track.rotations[frame].mT + self.track.translations[frame]

    def _at(self, time: float, weights: Callable[[float], Sequence[float]]) -> Tensor:
        scaled = min(max(time, 0.0), 1.0) * self.segments
        k = min(int(scaled), self.segments - 1)
        w = self.control.new_tensor(weights(scaled - k))
        return (self.control[:, k : k + 4] * w[:, None]).sum(1)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = self._at(moment.time, basis)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        return rest.replace(means=means)

    def velocity(self, rest: Gaussians, moment: Moment) -> Tensor:
        """Metres per segment."""
        return self._at(moment.time, basis_derivative)

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        self.control.data += change.offsets[:, None]  # a turning object would turn these too
