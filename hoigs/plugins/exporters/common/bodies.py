"""A person over the exported moments, as skeletons and skinned meshes need it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    matrices_to_quats,
    multiply_quats,
    quats_to_axis_angle,
)
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.plugins.exporters.common.world import Move


@dataclass(frozen=True)
class BodyMotion:
    """One person over F moments, on the CPU.

    Attributes:
        name: of the entity. model: registry key of the body, as the clip has it.
        body: its model. betas: shape, one for all moments.
        rotations: axis-angle of each joint in its parent's frame; zero is the T-pose.
        transl: the pelvis is at rest_joints[0] + transl, metres.
        scale: of the whole body about its pelvis.
        rest_joints: in the T-pose, metres, unscaled.
    """

    name: str
    model: str
    gender: str | None
    body: BodyModel
    betas: Float[Tensor, " B"]
    rotations: Float[Tensor, "F J 3"]
    transl: Float[Tensor, "F 3"]
    scale: float
    rest_joints: Float[Tensor, "J 3"]

    def __len__(self) -> int:
        return len(self.transl)

    @property
    def pelvis(self) -> Float[Tensor, "F 3"]:
        """Metres, world."""
        return self.rest_joints[0] + self.transl

    def pose(self, index: int) -> BodyPose:
        """The pose at one moment, with flat hands."""
        turns = self.rotations[index]
        hands = turns[-30:]
        return BodyPose(
            turns[0], turns[1:22], hands[:15], hands[15:], self.transl[index], self.betas
        )

    def joints(self, index: int) -> Float[Tensor, "J 3"]:
        """World, metres, at one moment."""
        return self._scaled(self.body(self.pose(index)).joints, index)

    def vertices(self, index: int) -> Float[Tensor, "V 3"]:
        """World, metres, at one moment."""
        return self._scaled(self.body(self.pose(index)).vertices, index)

    def _scaled(self, points: Float[Tensor, "P 3"], index: int) -> Float[Tensor, "P 3"]:
        return self.pelvis[index] + self.scale * (points - self.pelvis[index])

    def moved(self, move: Move) -> BodyMotion:
        """The same in a world that is moved."""
        # in float64, as turns near 180 degrees lose digits in float32
        roots = axis_angle_to_quats(self.rotations[:, 0].double())
        first = matrices_to_quats(move.turn.double()).expand_as(roots)
        rotations = self.rotations.clone()
        rotations[:, 0] = quats_to_axis_angle(multiply_quats(first, roots)).to(rotations)
        transl = move.points(self.pelvis) - self.rest_joints[0]
        return replace(self, rotations=rotations, transl=transl)


def body_motions(request: ExportRequest) -> list[BodyMotion]:
    """The people among the entities to export.

    Raises:
        HoigsError: one has no body model.
    """
    return [body_motion(request, name) for name in request.of_kind("human")]


@torch.no_grad()
def body_motion(request: ExportRequest, name: str) -> BodyMotion:
    """One person; poses are those that are drawn: refined, and corrected by the interaction.

    Raises:
        HoigsError: there is no body model for this person, or no pose at a moment.
    """
    if name not in request.bodies:
        raise HoigsError(f'"{name}" has no body model, so there is no skeleton to export')
    body = request.bodies[name].cpu()
    poses = [_pose(request, name, moment).to("cpu") for moment in request.moments]
    betas = torch.stack([pose.betas for pose in poses]).mean(0)
    rotations = torch.stack([body.joint_rotations(pose) for pose in poses])
    rest = body.shaped(betas)[1]
    track = request.clip.bodies.get(name)
    deformation = request.scene.entity(name).deformation
    scale, pelvis = 1.0, None
    if isinstance(deformation, ProvidesSkeleton):
        scale = float(deformation.arm_length().cpu() / body.arm_length(betas))
        scale = 1.0 if abs(scale - 1) < 1e-4 else scale
        pelvis = torch.stack([deformation.anchors(m)[0].cpu() for m in request.moments])
    if pelvis is None:
        pelvis = torch.stack([body.shaped(p.betas)[1][0] + p.transl for p in poses])
    return BodyMotion(
        name,
        track.model if track else type(body).__name__,
        track.gender if track else None,
        body,
        betas,
        rotations,
        pelvis - rest[0],
        scale,
        rest,
    )


def _pose(request: ExportRequest, name: str, moment: Moment) -> BodyPose:
    deformation = request.scene.entity(name).deformation
    if not isinstance(deformation, ProvidesSkeleton):
        if name not in moment.poses:
            raise HoigsError(f'the moment at {float(moment.time):.3f} has no pose of "{name}"')
        return moment.poses[name]
    pose = deformation.pose(moment)
    residual = request.scene(moment, [name]).residuals.get(name)
    if residual is None or residual.pose is None or "pose" not in deformation.residuals:
        return pose
    rule: Any = getattr(getattr(deformation, "config", None), "residual_rule", "add")
    return pose.with_residual(residual.pose, rule)
