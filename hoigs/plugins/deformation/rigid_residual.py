"""deformation:rigid-residual: a rigid motion, and a small one of each Gaussian's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.device import Time
from hoigs.core.maths.splines import Knots, keyframe_count
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.deformation.rigid_spline import RigidSpline, RigidSplineConfig


class RigidResidualConfig(RigidSplineConfig):
    """As RigidSplineConfig, and the knots of the offsets."""

    residual_step: int = Field(default=8, ge=1)
    """Frames between knots of the offsets, which change more slowly than the pose."""


class RigidResidual(RigidSpline):
    """RigidSpline over p + d_p(t): what a rigid motion cannot explain, in the object's own frame.

    d is a cubic Hermite spline per Gaussian with finite-difference tangents, zero at the start;
    its parameter is `offsets` [N, J, 3], metres, at J uniform knots: one every `residual_step`
    frames, or K where the number of frames is not known. Its mean square is penalised
    ("residual"), so that the rigid motion explains what it can. A child of density control has the
    offsets of its parent.
    """

    Config: ClassVar = RigidResidualConfig
    cuda_graph_safe = True
    per_gaussian = ("offsets",)
    rates: ClassVar[Mapping[str, str]] = {**RigidSpline.rates, "offsets": "keyframes"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        **RigidSpline.regularizer_weights,
        "residual": 1.0,
    }

    config: RigidResidualConfig
    offsets: nn.Parameter

    def __init__(self, config: RigidResidualConfig | None = None, **given: Any) -> None:
        super().__init__(config, **given)
        frames, step = self.num_frames, self.config.residual_step
        self.residual_knots = Knots(keyframe_count(frames, step) if frames else self.keyframes)

    def bind(self, canonical: Gaussians) -> None:
        super().bind(canonical)
        self.offsets = nn.Parameter(
            canonical.means.new_zeros(len(canonical), len(self.residual_knots), 3)
        )

    def shape(
        self, canonical: Gaussians, time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        offsets = self.residual_knots.catmull_rom(self.offsets, time)
        return canonical.means + offsets, canonical.quats

    def shape_velocity(self, canonical: Gaussians, time: Time) -> Float[Tensor, "N 3"]:
        own = self.residual_knots.catmull_rom(self.offsets, time, derivative=True)
        return own * (self.knots.reference / self.residual_knots.reference)

    def regularizers(self) -> dict[str, Tensor]:
        """As RigidSpline; "residual": mean square length of the offsets, square metres."""
        penalty = self.offsets.square().sum(-1).mean() if len(self.offsets) else torch.zeros(())
        return {**super().regularizers(), "residual": penalty.to(self.offsets)}
