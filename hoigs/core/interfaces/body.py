"""BodyModel: a skinned human in the SMPL-X convention, whatever file it came from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose

PART_NAMES = (
    "pelvis", "belly", "chest", "head", "left upper arm", "right upper arm", "left forearm",
    "right forearm", "left hand", "right hand", "left thigh", "right thigh", "left shin",
    "right shin", "left foot", "right foot",
)  # fmt: skip
HEAD_PART, LEFT_HAND_PART, RIGHT_HAND_PART = 3, 8, 9

# SMPL-X joint -> part for the 22 body joints; all left-hand joints are part 8, right-hand 9
BODY_JOINT_PARTS = (0, 10, 11, 1, 12, 13, 1, 14, 15, 2, 14, 15, 3, 2, 2, 3, 4, 5, 6, 7, 8, 9)

PELVIS, LEFT_FOOT, RIGHT_FOOT = 0, 10, 11
LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW, RIGHT_ELBOW, LEFT_WRIST, RIGHT_WRIST = range(16, 22)


@dataclass(frozen=True)
class BodyOutput:
    """A posed body, world, metres."""

    vertices: Float[Tensor, "*batch V 3"]
    joints: Float[Tensor, "*batch J 3"]


@dataclass(frozen=True)
class BodySurface:
    """P points on the body's surface in the canonical (zero) pose.

    Attributes:
        points: metres, body coordinates, mean shape or the given betas.
        normals: unit.
        spacing: typical distance to the next point, metres.
        weights: skinning weights, rows sum to 1.
        parts: 0..15, an index of PART_NAMES.
        faces: face on which each point lies. barycentric: its coordinates there.
    """

    points: Float[Tensor, "P 3"]
    normals: Float[Tensor, "P 3"]
    spacing: Float[Tensor, " P"]
    weights: Float[Tensor, "P J"]
    parts: Int[Tensor, " P"]
    faces: Int[Tensor, " P"]
    barycentric: Float[Tensor, "P 3"]


class BodyModel(Configurable, nn.Module, ABC):
    """Linear blend skinning over a joint tree in SMPL-X's order.

    The first 22 joints are SMPL-X's body joints. Models may have 52 joints (then 15 left-hand
    and 15 right-hand joints follow) or 55 (jaw and two eyes come between body and hands).
    Zero pose is the T-pose, y up, facing +z; every joint's local frame is aligned with the world
    in that pose, so one BodyPose means the same on every model.

    Attributes:
        joint_names: J names. parents: J indices, -1 for the root.
        num_betas: shape coefficients that the model takes.
        faces: triangles, int64 [F, 3]. skinning_weights: [V, J].
        vertex_parts: part of each vertex, int64 [V].
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    num_betas: int
    faces: Int[Tensor, "F 3"]
    skinning_weights: Float[Tensor, "V J"]
    vertex_parts: Int[Tensor, " V"]

    @abstractmethod
    def shaped(
        self, betas: Float[Tensor, "*batch B"]
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch J 3"]]:
        """Vertices and joints in the zero pose, metres, before `transl`."""

    @abstractmethod
    def forward(self, pose: BodyPose) -> BodyOutput:
        """Vertices and joints in the world; differentiable in pose, betas and transl."""

    @abstractmethod
    def skinning_transforms(self, pose: BodyPose) -> Float[Tensor, "*batch J 4 4"]:
        """World transform of each joint times its inverse in the zero pose, `transl` included.

        It takes a point p that is bound to joint j in the zero pose to T_j p in the world, metres.
        """

    @abstractmethod
    def surface(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> BodySurface:
        """Points on the surface in the zero pose.

        Args:
            count: spread evenly by area; None takes the vertices. betas: zero when None.
        """

    def canonical(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> Gaussians:
        """Grey Gaussians on `surface(count, betas, seed)`, as wide as their spacing."""
        surface = self.surface(count, betas, seed)
        return Gaussians.from_points(surface.points, scales=surface.spacing, opacity=0.9)

    def joint_rotations(self, pose: BodyPose) -> Float[Tensor, "*batch J 3"]:
        """Axis-angle of each of this model's joints (identity for jaw and eyes)."""
        rotations = pose.rotations
        if len(self.parents) == 52:
            return rotations
        face = torch.zeros_like(rotations[..., :3, :])
        return torch.cat((rotations[..., :22, :], face, rotations[..., 22:, :]), -2)

    def arm_length(self, betas: Float[Tensor, " B"]) -> Float[Tensor, ""]:
        """Shoulder to middle fingertip in the zero pose, mean of both arms, metres.

        The fingertip is the vertex of the hand that is farthest from the wrist.
        """
        vertices, joints = self.shaped(betas)
        lengths = []
        for shoulder, elbow, wrist, part in (
            (LEFT_SHOULDER, LEFT_ELBOW, LEFT_WRIST, LEFT_HAND_PART),
            (RIGHT_SHOULDER, RIGHT_ELBOW, RIGHT_WRIST, RIGHT_HAND_PART),
        ):
            hand = vertices.index_select(0, self._vertices_of(part))
            tip = (hand - joints[wrist]).norm(dim=-1).max()
            upper = (joints[elbow] - joints[shoulder]).norm()
            lengths.append(upper + (joints[wrist] - joints[elbow]).norm() + tip)
        return torch.stack(lengths).mean()

    def _vertices_of(self, part: int) -> Int[Tensor, " H"]:
        """Rows of a part's vertices; cached, as `nonzero` waits for the device."""
        known: dict[Any, Tensor] = self.__dict__.setdefault("_rows_of_parts", {})
        key = (part, self.vertex_parts.device)
        if key not in known:
            known[key] = (self.vertex_parts == part).nonzero().squeeze(1)
        return known[key]
