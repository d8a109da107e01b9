"""deformation:rigid-residual: a rigid motion, and a small one of each Gaussian's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core import spline
from hoigs.core.clock import Time
from hoigs.core.context import BuildContext
from hoigs.core.gaussians import Gaussians
from hoigs.plugins.deformation.knots import Knots
from hoigs.plugins.deformation.rigid_spline import RigidSpline, RigidSplineConfig


class RigidResidualConfig(RigidSplineConfig):
    """As RigidSplineConfig, and the knots of the offsets.

    Attributes:
        residual_step: frames between knots of the offsets, which change more slowly than the pose.
    """

    residual_step: int = Field(8, ge=1)


class RigidResidual(RigidSpline):
    """RigidSpline over p + d_p(t): what a rigid motion cannot explain, in the object's own frame.

    d is a cubic Hermite spline per Gaussian with finite-difference tangents, zero at the start;
    its parameter is `offsets` [N, J, 3], metres, at J uniform knots. Its mean square is penalised
    ("residual"), so that the rigid motion explains what it can. A child of density control has the
    offsets of its parent.

    Args:
        residual_keyframes: J; or None with `num_frames` or a `track`, for one every
            `residual_step` frames. Others: as RigidSpline.
    """

    recordable = True
    per_gaussian = ("offsets",)
    rates: ClassVar[Mapping[str, str]] = {**RigidSpline.rates, "offsets": "keyframes"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        **RigidSpline.regularizer_weights,
        "residual": 1.0,
    }

    offsets: nn.Parameter

    def __init__(
        self,
        keyframes: int | None = None,
        *,
        residual_keyframes: int | None = None,
        residual_step: int = 8,
        num_frames: int | None = None,
        **motion: Any,
    ) -> None:
        super().__init__(keyframes, num_frames=num_frames, **motion)
        if residual_keyframes is None:
            track = motion.get("track")
            frames = num_frames if num_frames is not None else track and len(track.rotations)
            residual_keyframes = spline.keyframe_count(frames, residual_step) if frames else 0
            residual_keyframes = residual_keyframes or self.keyframes
        self.residual_knots = Knots(residual_keyframes)

    @classmethod
    def from_config(cls, config: RigidResidualConfig, context: BuildContext) -> Self:
        return cls(residual_step=config.residual_step, **cls._arguments(config, context))

    def bind(self, rest: Gaussians) -> None:
        super().bind(rest)
        self.offsets = nn.Parameter(rest.means.new_zeros(len(rest), len(self.residual_knots), 3))

    def shape(
        self, rest: Gaussians, time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        return rest.means + self.residual_knots.catmull_rom(self.offsets, time), rest.quats

    def shape_velocity(self, rest: Gaussians, time: Time) -> Float[Tensor, "N 3"]:
        del rest
        own = self.residual_knots.catmull_rom(self.offsets, time, derivative=True)
        return own * (self.knots.reference / self.residual_knots.reference)

    def regularizers(self) -> dict[str, Tensor]:
        """As RigidSpline; "residual": mean square length of the offsets, square metres."""
        penalty = self.offsets.square().sum(-1).mean() if len(self.offsets) else torch.zeros(())
        return {**super().regularizers(), "residual": penalty.to(self.offsets)}
