"""deformation:articulated: two rigid parts about one learned joint, as ARCTIC's objects have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hoigs.core.device import Time
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.core.maths.splines import Times, cubic_hermite, one_time
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.deformation.keyframes import KeyframedConfig
from hoigs.plugins.deformation.rigid_spline import RigidSpline, RigidSplineConfig

Vector = tuple[float, float, float]
CONFIDENT = 3.0  # logit of a part label that is given: a weight of 0.95


class ArticulatedConfig(RigidSplineConfig):
    """As RigidSplineConfig, and the joint."""

    joint: Literal["revolute", "prismatic"] = "revolute"
    """"revolute" turns the moving part about the axis, "prismatic" slides it along."""
    axis: Vector | None = None
    """Where the joint starts from, in the object's frame, metres; None guesses from the shape.
    ARCTIC's objects have axis (0, 0, -1) and pivot (0, 0, 0)."""
    pivot: Vector | None = None
    """Where the joint starts from, in the object's frame, metres; None guesses from the shape.
    ARCTIC's objects have axis (0, 0, -1) and pivot (0, 0, 0)."""


class Articulated(RigidSpline):
    """RigidSpline whose moving part first turns about, or slides along, a joint of its own.

    Each Gaussian has a weight w = sigmoid(`part_logits`) of belonging to the moving part. A
    revolute joint turns it by w theta(t) about the axis through the pivot, so that Gaussians
    between the parts bend without shrinking, as blended positions would; a prismatic joint slides
    it by w theta(t) along the axis. theta is a cubic Hermite spline with the keyframes of the pose.

    Further parameters: `part_logits` [N]; `axis` [3], normalised when used, and `pivot` [3],
    metres, in the object's frame; `joint_values` and `joint_tangents` [K, 1], radians or metres,
    zero at the start. "parts" penalises w (1 - w), so that weights decide.

    Without `moving`, Gaussians beyond the middle of the object's longest axis start as the moving
    part, with weights that grow from 0.2 at one end to 0.8 at the other; the pivot starts in the
    middle, the axis along the second longest axis (revolute) or the longest (prismatic).

    Args:
        moving: for each of the track's points, whether it belongs to the moving part. Others: as
            RigidSpline.

    Raises:
        ValueError: `moving` without a track, or of another length than its points; a zero axis.
    """

    Config: ClassVar = ArticulatedConfig
    cuda_graph_safe = True
    per_gaussian = ("part_logits",)
    rates: ClassVar[Mapping[str, str]] = {
        **RigidSpline.rates,
        "part_logits": "opacity",
        "axis": "keyframe_rotation",
        "pivot": "keyframes",
        "joint_": "keyframe_rotation",
    }
    resizes: ClassVar[Mapping[str, int]] = {
        **RigidSpline.resizes,
        "joint_values": 0,
        "joint_tangents": 0,
    }
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        **RigidSpline.regularizer_weights,
        "parts": 0.01,
    }

    config: ArticulatedConfig
    part_logits: nn.Parameter
    axis: nn.Parameter
    pivot: nn.Parameter
    joint_values: nn.Parameter
    joint_tangents: nn.Parameter

    def __init__(
        self,
        config: ArticulatedConfig | None = None,
        *,
        moving: Bool[Tensor, " P"] | None = None,
        **given: Any,
    ) -> None:
        super().__init__(config, **given)
        track = self._track
        if moving is not None and (track is None or len(track.points) != len(moving)):
            points = "no track" if track is None else f"a track of {len(track.points)} points"
            raise ValueError(f"{len(moving)} part labels for {points}: give one a point")
        if self.config.axis is not None and not any(self.config.axis):
            raise ValueError("the axis of a joint cannot be (0, 0, 0)")
        labelled = None if moving is None or track is None else (moving, track.points)
        self._labelled: tuple[Tensor, Tensor] | None = labelled
        self.knot_axes = {**self.knot_axes, "joint_values": 0}
        if self.learned:
            self.knot_axes = {**self.knot_axes, "joint_tangents": 0}

    @staticmethod
    def given(config: KeyframedConfig, context: BuildContext) -> dict[str, Any]:
        given = RigidSpline.given(config, context)
        track = given["track"]
        return {**given, "moving": None if track is None else track.moving}

    def _initial(self, means: Tensor) -> dict[str, Tensor]:
        still = means.new_zeros(self.keyframes, 1)
        return {**super()._initial(means), "joint_values": still, "joint_tangents": still.clone()}

    def bind(self, canonical: Gaussians) -> None:
        super().bind(canonical)
        means, axis, pivot = canonical.means.detach(), self.config.axis, self.config.pivot
        if len(means):
            middle = means.mean(0)
            # principal axes, the longest first
            directions = torch.linalg.svd(means - middle, full_matrices=True)[2]
        else:
            middle, directions = means.new_zeros(3), torch.eye(3).to(means)
        logits = (means - middle) @ directions[0]
        if len(means):
            logits = 1.4 * logits / logits.abs().max().clamp_min(1e-6)
        if self._labelled is not None:
            from scipy.spatial import cKDTree  # on use: scipy takes a while to import

            moving, points = self._labelled
            _, nearest = cKDTree(points.cpu().numpy()).query(means.cpu().numpy())
            logits = CONFIDENT * (2 * moving[torch.as_tensor(nearest)].to(means) - 1)
        guess = directions[1 if self.config.joint == "revolute" else 0]
        self.part_logits = nn.Parameter(logits.clone())
        self.axis = nn.Parameter(guess.clone() if axis is None else means.new_tensor(axis))
        self.pivot = nn.Parameter(middle.clone() if pivot is None else means.new_tensor(pivot))
        self._labelled = None

    def joint_at(self, times: Times, *, derivative: bool = False) -> Float[Tensor, "T 1"]:
        """theta, or its derivative per keyframe interval: radians, or metres."""
        values = self.joint_values
        tangents = self.joint_tangents if self.learned else self.knots.differences(values[None])[0]
        at = self.knots.at_times(times, values)
        return cubic_hermite(values, tangents, at, derivative=derivative)

    def shape(
        self, canonical: Gaussians, time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        amount = torch.sigmoid(self.part_logits)[:, None] * self.joint_at(one_time(time))
        axis = torch.nn.functional.normalize(self.axis, dim=0)
        if self.config.joint == "prismatic":
            return canonical.means + amount * axis, canonical.quats
        turns = axis_angle_to_quats(amount * axis)
        arms = (quats_to_matrices(turns) @ (canonical.means - self.pivot)[..., None]).squeeze(-1)
        return self.pivot + arms, multiply_quats(turns, normalize_quats(canonical.quats))

    def shape_velocity(self, canonical: Gaussians, time: Time) -> Float[Tensor, "N 3"]:
        axis = torch.nn.functional.normalize(self.axis, dim=0)
        speed = self.joint_at(one_time(time), derivative=True)
        rate = torch.sigmoid(self.part_logits)[:, None] * speed * axis
        if self.config.joint == "prismatic":
            return rate
        return torch.linalg.cross(rate, self.shape(canonical, time)[0] - self.pivot)

    @torch.no_grad()
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        if fit:
            values, tangents = self.refitted(self.joint_at(fit), fit, times)
        else:
            values, tangents = self.joint_at(times), self.joint_at(times, derivative=True)
        found = {**super().resampled(times, fit), "joint_values": values}
        return {**found, "joint_tangents": tangents} if self.learned else found

    def regularizers(self) -> dict[str, Tensor]:
        """As RigidSpline; "parts": mean of w (1 - w) over the Gaussians."""
        weights = torch.sigmoid(self.part_logits)
        undecided = (weights * (1 - weights)).mean() if len(weights) else weights.sum()
        return {**super().regularizers(), "parts": undecided}
