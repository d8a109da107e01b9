"""Per-Gaussian uniform cubic B-splines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Self

import torch
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange


class UniformBSplineConfig(ComponentConfig):
    """Settings of `deformation:b-spline`."""

    step: int = Field(default=4, ge=1)
    """Frames between two control points."""


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
    """Means on a B-spline; everything else as in the canonical Gaussians.

    Args:
        num_frames: of the clip; with `step` it gives the number of segments, at least one.
        track: poses that the control points start at; without one, all are the canonical means.
    """

    Config: ClassVar = UniformBSplineConfig
    provides = frozenset({"velocity"})  # so that features:spline-motion can describe it
    owns = frozenset({"means"})
    per_gaussian = ("control",)
    rates: ClassVar[Mapping[str, str]] = {"control": "keyframes"}

    def __init__(
        self,
        config: UniformBSplineConfig | None = None,
        *,
        num_frames: int,
        track: ObjectTrack | None = None,
    ) -> None:
        super().__init__()
        self.config = config or UniformBSplineConfig()
        self.segments = max(1, round((num_frames - 1) / self.config.step))
        self.track = track
        self.input_space = "world" if track is None else "canonical"

    @classmethod
    def from_config(cls, config: UniformBSplineConfig, context: BuildContext) -> Self:
        if context.clip is None:
            raise ValueError("deformation:b-spline needs a clip, for its number of frames")
        return cls(config, num_frames=context.clip.num_frames, track=context.object_track)

    def bind(self, canonical: Gaussians) -> None:
        means = canonical.means.detach()
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
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = self._at(moment.time, basis)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        return canonical.replace(means=means)

    def velocity(self, canonical: Gaussians, moment: Moment) -> Tensor:
        """Metres per segment."""
        return self._at(moment.time, basis_derivative)

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        self.control.data += change.offsets[:, None]  # exact unless the object turns
