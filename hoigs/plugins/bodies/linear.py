"""LinearBody: what every body made of a template, shape directions and skinning weights shares."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.body import BODY_JOINT_PARTS, PART_NAMES, BodyModel, BodyOutput, BodySurface
from hoigs.core.errors import HoigsError
from hoigs.core.moment import BodyPose
from hoigs.core.rotation import axis_angle_to_matrices
from hoigs.core.skinning import (
    blend,
    neighbour_spacing,
    pose_joints,
    sample_triangles,
    skinning_matrices,
    triangle_areas,
    vertex_normals,
)

HEAD, LEFT_HAND, RIGHT_HAND = 3, 8, 9


def parts_of_joints(count: int) -> tuple[int, ...]:
    """Part (index of PART_NAMES) of each of a model's 52 or 55 joints."""
    face = (HEAD,) * (count - 52)
    return (*BODY_JOINT_PARTS, *face, *(LEFT_HAND,) * 15, *(RIGHT_HAND,) * 15)


class LinearBody(BodyModel):
    """v(betas) = template + shape_directions . betas, then linear blend skinning.

    All arrays are in the zero pose (T-pose). Computation runs in the dtype of the pose; buffers
    are not saved in checkpoints, as they come from the body's own file.

    Args:
        template: metres. shape_directions: metres per unit of each coefficient.
        joints, joint_directions: the same for the joints.
        weights: skinning weights; rows are normalised here.
    """

    template: Float[Tensor, "V 3"]
    shape_directions: Float[Tensor, "B V 3"]
    joints: Float[Tensor, "J 3"]
    joint_directions: Float[Tensor, "B J 3"]

    def __init__(
        self,
        *,
        template: Float[Tensor, "V 3"],
        shape_directions: Float[Tensor, "B V 3"],
        joints: Float[Tensor, "J 3"],
        joint_directions: Float[Tensor, "B J 3"],
        weights: Float[Tensor, "V J"],
        faces: Int[Tensor, "F 3"],
        joint_names: Sequence[str],
        parents: Sequence[int],
    ) -> None:
        super().__init__()
        self.joint_names = tuple(joint_names)
        self.parents = tuple(int(p) for p in parents)
        self.num_betas = len(shape_directions)
        weights = weights / weights.sum(1, keepdim=True)
        share = torch.zeros(len(weights), len(PART_NAMES), dtype=weights.dtype)
        share.index_add_(1, torch.tensor(parts_of_joints(len(self.parents))), weights)
        for name, value in {
            "template": template,
            "shape_directions": shape_directions,
            "joints": joints,
            "joint_directions": joint_directions,
            "skinning_weights": weights,
            "faces": faces.long(),
            "vertex_parts": share.argmax(1),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def shaped(
        self, betas: Float[Tensor, "*batch B"]
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch J 3"]]:
        if betas.shape[-1] != self.num_betas:
            raise HoigsError(
                f"{type(self).__name__} takes {self.num_betas} shape coefficients (betas), got "
                f"{betas.shape[-1]}; pad with zeros or cut them, or change num_betas"
            )
        vertices = self._along(self.template, self.shape_directions, betas)
        return vertices, self._along(self.joints, self.joint_directions, betas)

    def joint_rotations(self, pose: BodyPose) -> Float[Tensor, "*batch J 3"]:
        return super().joint_rotations(self.flat_hands(pose))

    def flat_hands(self, pose: BodyPose) -> BodyPose:
        """The same pose in the "flat" hand convention; this body has no mean hand to add."""
        if pose.hand_pose_convention != "flat":
            raise HoigsError(
                f"{type(self).__name__} has no mean hand: it takes poses with "
                'hand_pose_convention="flat", got "mean"; convert them with the SMPL-X model '
                "that they come from, SmplxBody(path).flat_hands(pose)"
            )
        return pose

    def forward(self, pose: BodyPose) -> BodyOutput:
        vertices, joints = self.shaped(pose.betas.to(pose.transl))
        rotations, turns, places = self._kinematics(pose, joints)
        transforms = skinning_matrices(turns, places, joints)
        vertices = self._pose_corrected(vertices, rotations)
        posed = blend(vertices, self.skinning_weights.to(pose.transl), transforms)
        return BodyOutput(posed, places)

    def skinning_transforms(self, pose: BodyPose) -> Float[Tensor, "*batch J 4 4"]:
        betas = pose.betas.to(pose.transl)
        joints = self._along(self.joints, self.joint_directions, betas)
        _, turns, places = self._kinematics(pose, joints)
        return skinning_matrices(turns, places, joints)

    def surface(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> BodySurface:
        if betas is None:
            betas = self.template.new_zeros(self.num_betas)
        if count is not None and count < 2:
            raise ValueError(f"count: expected at least 2 points on the surface, got {count}")
        vertices, _ = self.shaped(betas)
        if count is None:
            face, barycentric = self._a_face_of_each_vertex()
            normals = vertex_normals(vertices, self.faces)
        else:
            areas, face_normals = triangle_areas(vertices, self.faces)
            face, barycentric = sample_triangles(areas, count, seed)
            normals = face_normals[face]
        barycentric = barycentric.to(vertices)
        corners = self.faces[face]
        mix = lambda values: (values[corners] * barycentric[..., None]).sum(1)  # noqa: E731
        points = mix(vertices)
        one_hot = torch.nn.functional.one_hot(self.vertex_parts, len(PART_NAMES)).to(vertices)
        return BodySurface(
            points=points,
            normals=normals,
            spacing=neighbour_spacing(points),
            weights=mix(self.skinning_weights.to(vertices)),
            parts=mix(one_hot).argmax(1),
            faces=face,
            barycentric=barycentric,
        )

    def _pose_corrected(self, vertices: Tensor, rotations: Tensor) -> Tensor:
        """Pose blendshapes, for the models that have them. rotations: [*batch, J, 3, 3]."""
        return vertices

    def _kinematics(self, pose: BodyPose, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Local rotations, world rotations and world positions of the joints."""
        rotations = axis_angle_to_matrices(self.joint_rotations(pose))
        turns, places = pose_joints(rotations, joints, self.parents)
        return rotations, turns, places + pose.transl[..., None, :]

    @staticmethod
    def _along(base: Tensor, directions: Tensor, betas: Tensor) -> Tensor:
        offset = betas @ directions.to(betas).flatten(1)
        return base.to(betas) + offset.unflatten(-1, base.shape)

    def _a_face_of_each_vertex(self) -> tuple[Tensor, Tensor]:
        """Some triangle that each vertex belongs to, and the vertex's corner there as one-hot."""
        count = len(self.template)
        slot = torch.full((count,), -1, dtype=torch.long, device=self.faces.device)
        slots = torch.arange(self.faces.numel(), device=self.faces.device)
        slot[self.faces.flatten()] = slots
        if bool((slot < 0).any()):
            lonely = int((slot < 0).nonzero()[0])
            raise HoigsError(f"vertex {lonely} of the body belongs to no triangle")
        return slot // 3, torch.nn.functional.one_hot(slot % 3, 3)
