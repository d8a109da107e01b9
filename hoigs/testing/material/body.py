"""A tiny body on SMPL-X's joint tree, with six vertices around each of 52 joints."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from hoigs.core.cuda_graphs.device_constants import constant
from hoigs.core.interfaces.body import BODY_JOINT_PARTS, BodyModel, BodyOutput, BodySurface
from hoigs.core.maths.skinning import joint_transforms, skin, transform_points
from hoigs.core.values.moment import BodyPose

# SMPL-X's body joints: pelvis, hips, spine1, knees, spine2, ankles, spine3, feet, neck, collars,
# head, shoulders, elbows, wrists; left before right
SMPLX_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
JOINTS = (
    (0, 0, 0), (0.1, -0.1, 0), (-0.1, -0.1, 0), (0, 0.12, 0), (0.1, -0.5, 0), (-0.1, -0.5, 0),
    (0, 0.25, 0), (0.1, -0.9, 0), (-0.1, -0.9, 0), (0, 0.33, 0), (0.1, -0.95, 0.1),
    (-0.1, -0.95, 0.1), (0, 0.5, 0), (0.07, 0.43, 0), (-0.07, 0.43, 0), (0, 0.6, 0),
    (0.18, 0.45, 0), (-0.18, 0.45, 0), (0.45, 0.45, 0), (-0.45, 0.45, 0), (0.7, 0.45, 0),
    (-0.7, 0.45, 0),
)  # fmt: skip
FACES = ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5))


class TinyBody(BodyModel):
    """Octahedra around joints, with a skinning weight of 0.2 for the parent; two betas.

    It computes in the dtype of the pose.
    """

    num_betas = 2

    joints: Tensor
    template: Tensor

    def __init__(self) -> None:
        super().__init__()
        places = [torch.tensor(p, dtype=torch.float32) for p in JOINTS]
        parents, parts = list(SMPLX_PARENTS), list(BODY_JOINT_PARTS)
        for wrist, side, part in ((20, 1.0, 8), (21, -1.0, 9)):
            for finger in range(5):
                for bone in range(3):
                    parents.append(wrist if bone == 0 else len(parents) - 1)
                    step = torch.tensor((side * (0.05 + 0.03 * bone), 0, 0.02 * (finger - 2)))
                    places.append(places[wrist] + step)
                    parts.append(part)
        count = len(places)
        self.parents = tuple(parents)
        self.joint_names = tuple(f"joint{i}" for i in range(count))
        joints = torch.stack(places)
        radius = torch.where(torch.arange(count) < 22, 0.05, 0.012)
        corners = torch.cat((torch.eye(3), -torch.eye(3)))[[0, 3, 1, 4, 2, 5]]
        weights = 0.8 * torch.eye(count)
        for joint, parent in enumerate(parents):
            weights[joint, max(parent, 0)] += 0.2
        shifts = 6 * torch.arange(count)[:, None, None]
        for name, value in {
            "joints": joints,
            "template": (joints[:, None] + radius[:, None, None] * corners).flatten(0, 1),
            "faces": (torch.tensor(FACES) + shifts).flatten(0, 1),
            "skinning_weights": weights.repeat_interleave(6, 0),
            "vertex_parts": torch.tensor(parts).repeat_interleave(6),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def shaped(
        self, betas: Float[Tensor, "*batch B"]
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch J 3"]]:
        taller = constant((0.0, 1.0, 0.0), like=betas)
        size = (1 + 0.1 * betas[..., :1] + 0.1 * betas[..., 1:2] * taller)[..., None, :]
        return self.template.to(betas) * size, self.joints.to(betas) * size

    def skinning_transforms(self, pose: BodyPose) -> Float[Tensor, "*batch J 4 4"]:
        joints = self.shaped(pose.betas.to(pose.transl))[1]
        return joint_transforms(self.joint_rotations(pose), joints, self.parents, pose.transl)

    def forward(self, pose: BodyPose) -> BodyOutput:
        transforms = self.skinning_transforms(pose)
        vertices, joints = self.shaped(pose.betas.to(pose.transl))
        weights = self.skinning_weights.to(pose.transl)
        return BodyOutput(skin(vertices, transforms, weights), transform_points(transforms, joints))

    def surface(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> BodySurface:
        """`count` random points, or one for each vertex."""
        betas = self.template.new_zeros(2) if betas is None else betas.to(self.template)
        vertices = self.shaped(betas)[0]
        if count is None:
            owner = torch.arange(len(vertices))
            faces = (self.faces[:, :, None] == owner).any(1).int().argmax(0)
            barycentric = (self.faces[faces] == owner[:, None]).to(vertices)
        else:
            generator = torch.Generator().manual_seed(seed)
            faces = torch.randint(len(self.faces), (count,), generator=generator)
            barycentric = torch.rand(count, 3, generator=generator) + 0.01
            barycentric = (barycentric / barycentric.sum(-1, keepdim=True)).to(vertices)
        corners = self.faces[faces]
        a, b, c = vertices[corners].unbind(1)
        points = (vertices[corners] * barycentric[..., None]).sum(1)
        nearest = corners.gather(1, barycentric.argmax(1, keepdim=True)).squeeze(1)
        return BodySurface(
            points=points,
            normals=normalize(torch.linalg.cross(b - a, c - a), dim=-1),
            spacing=torch.full_like(points[:, 0], 0.03),
            weights=(self.skinning_weights[corners] * barycentric[..., None]).sum(1),
            parts=self.vertex_parts[nearest],
            faces=faces,
            barycentric=barycentric,
        )
