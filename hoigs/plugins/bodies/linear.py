"""LinearBody: a body made of a template, shape directions and skinning weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import (
    BODY_JOINT_PARTS,
    HEAD_PART,
    LEFT_HAND_PART,
    PART_NAMES,
    RIGHT_HAND_PART,
    BodyModel,
    BodyOutput,
    BodySurface,
)
from hoigs.core.maths.skinning import joint_transforms, skin, transform_points
from hoigs.core.values.gaussians import neighbour_distances
from hoigs.core.values.moment import BodyPose

# Points spread evenly over the surface of a body, with weights, parts and triangles.


def sample_surface(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    weights: Float[Tensor, "V J"],
    vertex_parts: Int[Tensor, " V"],
    count: int | None,
    seed: int,
) -> BodySurface:
    """One point at each vertex (count None), or `count` points spread evenly by area.

    The points are at equal steps of the cumulated face area, each randomly shifted within its step,
    which avoids the clusters and gaps of independent draws. A seed always gives the same points.
    """
    if count is None:
        face, barycentric = _at_vertices(vertices, faces)
    else:
        face, barycentric = _by_area(vertices, faces, count, seed)
    corners = faces[face]
    interpolated = lambda values: (values[corners] * barycentric[..., None]).sum(1)  # noqa: E731
    points = interpolated(vertices)
    normals = vertex_normals(vertices, faces) if count is None else _directed(vertices, corners)
    nearest = corners.gather(1, barycentric.argmax(1, keepdim=True)).squeeze(1)
    return BodySurface(
        points=points,
        normals=torch.nn.functional.normalize(normals, dim=-1),
        spacing=neighbour_distances(points),
        weights=interpolated(weights),
        parts=vertex_parts[nearest],
        faces=face,
        barycentric=barycentric,
    )


def vertex_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Sum of the adjoining triangles' normals, longer for larger ones; not of unit length."""
    normals = _directed(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(0, faces[:, corner], normals)
    return total


def _directed(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Right-hand normal of each triangle, twice its area long."""
    a, b, c = vertices[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


def _at_vertices(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Int[Tensor, " V"], Float[Tensor, "V 3"]]:
    """For each vertex a face with that corner, and barycentric coordinates of the corner."""
    count = len(vertices)
    owner = torch.zeros(count, dtype=torch.int64, device=faces.device)
    corner = torch.zeros_like(owner)
    for k in range(3):
        owner[faces[:, k]] = torch.arange(len(faces), device=faces.device)
        corner[faces[:, k]] = k
    return owner, torch.nn.functional.one_hot(corner, 3).to(vertices)


def _by_area(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int, seed: int
) -> tuple[Int[Tensor, " P"], Float[Tensor, "P 3"]]:
    cumulated = _directed(vertices.detach().double(), faces).norm(dim=-1).cumsum(0)
    generator = torch.Generator().manual_seed(seed)
    shift = torch.rand(count, generator=generator, dtype=torch.float64)
    steps = (torch.arange(count, dtype=torch.float64) + shift) / count
    where = steps.to(cumulated) * cumulated[-1]
    face = torch.searchsorted(cumulated, where).clamp(max=len(faces) - 1)
    u, v = torch.rand(2, count, generator=generator).to(vertices).unbind(0)
    root = u.sqrt()
    barycentric = torch.stack((1 - root, root * (1 - v), root * v), -1)
    return face, barycentric


def parts_of_joints(count: int) -> tuple[int, ...]:
    """Part (an index of PART_NAMES) of each of a model's 52 or 55 joints."""
    face = (HEAD_PART,) * (count - 52)
    return (*BODY_JOINT_PARTS, *face, *(LEFT_HAND_PART,) * 15, *(RIGHT_HAND_PART,) * 15)


class LinearBody(BodyModel):
    """v(betas) = template + betas . shape_directions, then linear blend skinning.

    All arrays are in the zero pose (T-pose). The computation runs in the dtype of the pose.
    Buffers are not saved in checkpoints, as they come from the body's own file.

    Args:
        template: metres. shape_directions: metres per unit of each coefficient.
        joints, joint_shape_directions: the same for the joints.
        weights: skinning weights; rows are normalised here.
    """

    template: Float[Tensor, "V 3"]
    shape_directions: Float[Tensor, "B V 3"]
    joints: Float[Tensor, "J 3"]
    joint_shape_directions: Float[Tensor, "B J 3"]

    def __init__(
        self,
        *,
        template: Float[Tensor, "V 3"],
        shape_directions: Float[Tensor, "B V 3"],
        joints: Float[Tensor, "J 3"],
        joint_shape_directions: Float[Tensor, "B J 3"],
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
        share = weights.new_zeros(len(weights), len(PART_NAMES))
        share = share.index_add(1, torch.tensor(parts_of_joints(len(self.parents))), weights)
        for name, value in {
            "template": template,
            "shape_directions": shape_directions,
            "joints": joints,
            "joint_shape_directions": joint_shape_directions,
            "skinning_weights": weights,
            "faces": faces.long(),
            "vertex_parts": share.argmax(1),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def shaped(
        self, betas: Float[Tensor, "*batch B"]
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch J 3"]]:
        vertices = _along(self.template, self.shape_directions, self._checked(betas))
        return vertices, self._shaped_joints(betas)

    def joint_rotations(self, pose: BodyPose) -> Float[Tensor, "*batch J 3"]:
        return super().joint_rotations(self.flat_hands(pose))

    def flat_hands(self, pose: BodyPose) -> BodyPose:
        """The same pose in the "flat" hand convention; this body has no mean hand to add."""
        if pose.hand_pose_convention != "flat":
            raise HoigsError(
                f"{type(self).__name__} has no mean hand: it expects poses with "
                'hand_pose_convention="flat", got "mean"; convert them with the SMPL-X model that '
                "they come from: SmplxBody(config).flat_hands(pose)"
            )
        return pose

    def forward(self, pose: BodyPose) -> BodyOutput:
        vertices, joints = self.shaped(pose.betas.to(pose.transl))
        rotations = self.joint_rotations(pose)
        transforms = joint_transforms(rotations, joints, self.parents, pose.transl)
        vertices = self._pose_corrected(vertices, rotations)
        posed = skin(vertices, transforms, self.skinning_weights.to(pose.transl))
        return BodyOutput(posed, transform_points(transforms, joints))

    def skinning_transforms(self, pose: BodyPose) -> Float[Tensor, "*batch J 4 4"]:
        joints = self._shaped_joints(pose.betas.to(pose.transl))
        return joint_transforms(self.joint_rotations(pose), joints, self.parents, pose.transl)

    def surface(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> BodySurface:
        if betas is None:
            betas = self.template.new_zeros(self.num_betas)
        vertices, _ = self.shaped(betas.to(self.template))
        return sample_surface(
            vertices, self.faces, self.skinning_weights, self.vertex_parts, count, seed
        )

    def _pose_corrected(self, vertices: Tensor, rotations: Tensor) -> Tensor:
        """Pose blendshapes, for models that have them; rotations are axis-angle [*batch, J, 3]."""
        return vertices

    def _shaped_joints(self, betas: Tensor) -> Tensor:
        return _along(self.joints, self.joint_shape_directions, self._checked(betas))

    def _checked(self, betas: Tensor) -> Tensor:
        if betas.shape[-1] != self.num_betas:
            raise HoigsError(
                f"{type(self).__name__} takes {self.num_betas} shape coefficients (betas), got "
                f"{betas.shape[-1]}; pad them with zeros or truncate them"
            )
        return betas


def _along(base: Tensor, directions: Tensor, betas: Tensor) -> Tensor:
    offset = betas @ directions.to(betas).flatten(1)
    return base.to(betas) + offset.unflatten(-1, base.shape)
