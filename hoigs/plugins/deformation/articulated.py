"""deformation:articulated: two rigid parts about one learned joint, as ARCTIC's objects have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hoigs.core.clock import Time
from hoigs.core.context import BuildContext
from hoigs.core.gaussians import Gaussians
from hoigs.core.rotation import (
    axis_angle_to_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.plugins.deformation.knot_schedule import probe_rows
from hoigs.plugins.deformation.knots import Knots, one_time
from hoigs.plugins.deformation.rigid_spline import RigidSpline, RigidSplineConfig

Joint = Literal["revolute", "prismatic"]
Vector = tuple[float, float, float]

CONFIDENT = 3.0  # logit of a part label that is given: a weight of 0.95


class ArticulatedConfig(RigidSplineConfig):
    """As RigidSplineConfig, and the joint.

    Attributes:
        joint: "revolute" turns the moving part about the axis, "prismatic" slides it along.
        axis, pivot: where the joint starts from, in the object's frame, metres; None guesses from
            the shape. ARCTIC's objects have axis (0, 0, -1) and pivot (0, 0, 0).
    """

    joint: Joint = "revolute"
    axis: Vector | None = None
    pivot: Vector | None = None


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
        moving: for each of the track's points, whether it belongs to the moving part.
        others: as ArticulatedConfig and RigidSpline.

    Raises:
        ValueError: `moving` without a track, or of another length than its points; a zero axis.
    """

    recordable = True
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

    part_logits: nn.Parameter
    axis: nn.Parameter
    pivot: nn.Parameter
    joint_values: nn.Parameter
    joint_tangents: nn.Parameter

    def __init__(
        self,
        keyframes: int | None = None,
        *,
        joint: Joint = "revolute",
        axis: Vector | None = None,
        pivot: Vector | None = None,
        moving: Bool[Tensor, " P"] | None = None,
        **motion: Any,
    ) -> None:
        super().__init__(keyframes, **motion)
        track = motion.get("track")
        if moving is not None and (track is None or len(track.points) != len(moving)):
            points = "no track" if track is None else f"a track of {len(track.points)} points"
            raise ValueError(f"{len(moving)} part labels for {points}: give one a point")
        if axis is not None and not any(axis):
            raise ValueError("the axis of a joint cannot be (0, 0, 0)")
        self.joint = joint
        self._given = (axis, pivot, moving, None if track is None else track.points)
        self.knot_axes = {**self.knot_axes, "joint_values": 0}
        if self.learned:
            self.knot_axes = {**self.knot_axes, "joint_tangents": 0}

    @classmethod
    def from_config(cls, config: ArticulatedConfig, context: BuildContext) -> Self:
        track = context.object_track if config.track else None
        return cls(
            joint=config.joint,
            axis=config.axis,
            pivot=config.pivot,
            moving=None if track is None else track.moving,
            **cls._arguments(config, context),
        )

    def _initial(self, means: Tensor) -> dict[str, Tensor]:
        still = means.new_zeros(len(self.knots), 1)
        return {**super()._initial(means), "joint_values": still, "joint_tangents": still.clone()}

    def bind(self, rest: Gaussians) -> None:
        super().bind(rest)
        means = rest.means.detach()
        axis, pivot, moving, points = self._given
        middle = means.mean(0) if len(means) else means.new_zeros(3)
        spread = means - middle
        # principal axes, the longest first
        directions = torch.linalg.svd(spread, full_matrices=True)[2] if len(means) else None
        if directions is None:
            directions = torch.eye(3).to(means)
        along = spread @ directions[0]
        logits = 1.4 * along / along.abs().max().clamp_min(1e-6) if len(means) else along
        if moving is not None and points is not None:
            from scipy.spatial import cKDTree  # on use: scipy takes a while to import

            _, nearest = cKDTree(points.cpu().numpy()).query(means.cpu().numpy())
            logits = CONFIDENT * (2 * moving[torch.as_tensor(nearest)].to(means) - 1)
        guess = directions[1 if self.joint == "revolute" else 0]
        self.part_logits = nn.Parameter(logits.clone())
        self.axis = nn.Parameter(guess.clone() if axis is None else means.new_tensor(axis))
        self.pivot = nn.Parameter(middle.clone() if pivot is None else means.new_tensor(pivot))
        self._given = (axis, pivot, None, None)

    def joint_at(self, time: Time) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """theta and its derivative per keyframe interval: radians, or metres."""
        values = self.joint_values
        tangents = self.joint_tangents if self.learned else self.knots.differences(values[None])[0]
        theta = self.knots.hermite_at(values, tangents, one_time(time))
        speed = self.knots.hermite_at(values, tangents, one_time(time), derivative=True)
        return theta[0, 0], speed[0, 0]

    def shape(
        self, rest: Gaussians, time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        theta, _ = self.joint_at(time)
        amount = torch.sigmoid(self.part_logits)[:, None] * theta
        axis = torch.nn.functional.normalize(self.axis, dim=0)
        if self.joint == "prismatic":
            return rest.means + amount * axis, rest.quats
        turns = axis_angle_to_quats(amount * axis)
        arms = (quats_to_matrices(turns) @ (rest.means - self.pivot)[..., None]).squeeze(-1)
        return self.pivot + arms, multiply_quats(turns, normalize_quats(rest.quats))

    def shape_velocity(self, rest: Gaussians, time: Time) -> Float[Tensor, "N 3"]:
        _, speed = self.joint_at(time)
        axis = torch.nn.functional.normalize(self.axis, dim=0)
        rate = torch.sigmoid(self.part_logits)[:, None] * speed * axis
        if self.joint == "prismatic":
            return rate
        return torch.linalg.cross(rate, self.shape(rest, time)[0] - self.pivot)

    @torch.no_grad()
    def traced(self, rest: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        rows = probe_rows(len(rest)).to(rest.means.device)
        quats, places = self.placed(times)
        shapes = torch.stack([self.shape(rest, time)[0][rows] for time in times])
        turned = (shapes - self.center) @ quats_to_matrices(quats).mT
        return turned + (places + self.center)[:, None]

    @torch.no_grad()
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        reads = [self.joint_at(time) for time in times]
        values, tangents = (torch.stack(column)[:, None] for column in zip(*reads, strict=True))
        if fit:
            knots = Knots(self.keyframes, movable=True).to(values.device)
            knots.place(times)
            samples = torch.stack([self.joint_at(time)[0] for time in fit])[:, None]
            values, tangents = knots.refit(samples, fit, free_tangents=self.learned)
        found = {**super().resampled(times, fit), "joint_values": values}
        return {**found, "joint_tangents": tangents} if self.learned else found

    def regularizers(self) -> dict[str, Tensor]:
        """As RigidSpline; "parts": mean of w (1 - w) over the Gaussians."""
        weights = torch.sigmoid(self.part_logits)
        undecided = (weights * (1 - weights)).mean() if len(weights) else weights.sum()
        return {**super().regularizers(), "parts": undecided}
