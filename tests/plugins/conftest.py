"""A small body on the SMPL-X tree, so that the parts of a human are tested without any asset."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hoigs.core.body import BODY_JOINT_PARTS, BodyModel, BodyOutput, BodySurface
from hoigs.core.moment import BodyPose
from hoigs.core.rotation import axis_angle_to_matrices

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
JOINTS = (
    (0, 0, 0), (0.1, -0.1, 0), (-0.1, -0.1, 0), (0, 0.12, 0), (0.1, -0.5, 0), (-0.1, -0.5, 0),
    (0, 0.25, 0), (0.1, -0.9, 0), (-0.1, -0.9, 0), (0, 0.33, 0), (0.1, -0.95, 0.1),
    (-0.1, -0.95, 0.1), (0, 0.5, 0), (0.07, 0.43, 0), (-0.07, 0.43, 0), (0, 0.6, 0),
    (0.18, 0.45, 0), (-0.18, 0.45, 0), (0.45, 0.45, 0), (-0.45, 0.45, 0), (0.7, 0.45, 0),
    (-0.7, 0.45, 0),
)  # fmt: skip


class ToyBody(BodyModel):
    """Six faces about each of 52 joints; weights shared with the parent; two shape terms."""

    num_betas = 2

    def __init__(self) -> None:
        super().__init__()
        joints = [torch.tensor(p, dtype=torch.float32) for p in JOINTS]
        parents, parts = list(PARENTS), list(BODY_JOINT_PARTS)
        for wrist, side, part in ((20, 1.0, 8), (21, -1.0, 9)):
            for finger in range(5):
                for bone in range(3):
                    parents.append(wrist if bone == 0 else len(parents) - 1)
                    step = torch.tensor((side * (0.05 + 0.03 * bone), 0, 0.02 * (finger - 2)))
                    joints.append(joints[wrist] + step)
                    parts.append(part)
        self.parents = tuple(parents)
        self.joint_names = tuple(f"joint{i}" for i in range(52))
        self.register_buffer("joints", torch.stack(joints))
        radius = torch.full((52,), 0.05)
        radius[22:] = 0.012
        corners = torch.tensor(
            ((1.0, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
        )
        vertices = self.joints[:, None] + radius[:, None, None] * corners
        self.register_buffer("template", vertices.flatten(0, 1))
        octahedron = torch.tensor(
            ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5))
        )
        self.register_buffer(
            "faces", (octahedron + 6 * torch.arange(52)[:, None, None]).flatten(0, 1)
        )
        weights = 0.8 * torch.eye(52)
        for joint, parent in enumerate(parents):
            weights[joint, max(parent, 0)] += 0.2
        self.register_buffer("skinning_weights", weights.repeat_interleave(6, 0))
        self.register_buffer("vertex_parts", torch.tensor(parts).repeat_interleave(6))

    def shaped(self, betas: Tensor) -> tuple[Tensor, Tensor]:
        scale = 1 + 0.1 * betas[..., :1, None] * torch.ones(3)
        scale = scale + 0.1 * betas[..., 1:2, None] * torch.tensor((0.0, 1.0, 0.0))
        return self.template * scale, self.joints * scale

    def skinning_transforms(self, pose: BodyPose) -> Tensor:
        _, joints = self.shaped(pose.betas)
        turns = axis_angle_to_matrices(pose.rotations)
        rotations, places = [turns[0]], [joints[0] + pose.transl]
        for joint, parent in enumerate(self.parents[1:], start=1):
            rotations.append(rotations[parent] @ turns[joint])
            places.append(places[parent] + rotations[parent] @ (joints[joint] - joints[parent]))
        rotation, place = torch.stack(rotations), torch.stack(places)
        shift = place - (rotation @ joints[..., None]).squeeze(-1)
        top = torch.cat((rotation, shift[..., None]), -1)
        bottom = top.new_tensor((0.0, 0, 0, 1)).expand(52, 1, 4)
        return torch.cat((top, bottom), -2)

    def forward(self, pose: BodyPose) -> BodyOutput:
        transforms = self.skinning_transforms(pose)
        vertices, joints = self.shaped(pose.betas)

        def moved(points: Tensor, matrices: Tensor) -> Tensor:
            return (matrices[:, :3, :3] @ points[..., None]).squeeze(-1) + matrices[:, :3, 3]

        blended = torch.einsum("vj,jab->vab", self.skinning_weights, transforms)
        return BodyOutput(moved(vertices, blended), moved(joints, transforms))

    def surface(self, count=None, betas=None, seed=0) -> BodySurface:
        betas = torch.zeros(2) if betas is None else betas
        generator = torch.Generator().manual_seed(seed)
        count = 300 if count is None else count
        faces = torch.randint(len(self.faces), (count,), generator=generator)
        barycentric = torch.rand(count, 3, generator=generator) + 0.01
        barycentric = barycentric / barycentric.sum(-1, keepdim=True)
        corners = self.faces[faces]

        def mixed(values: Tensor) -> Tensor:
            return (values[corners] * barycentric[..., None]).sum(1)

        points = mixed(self.shaped(betas)[0])
        return BodySurface(
            points=points,
            normals=torch.nn.functional.normalize(points, dim=-1),
            spacing=torch.full((count,), 0.03),
            weights=mixed(self.skinning_weights),
            parts=self.vertex_parts[corners[:, 0]],
            faces=faces,
            barycentric=barycentric,
        )


@pytest.fixture(scope="session")
def toy_body() -> ToyBody:
    return ToyBody()


@pytest.fixture
def toy_pose():
    def make(seed: int = 0, size: float = 0.4, dtype: torch.dtype = torch.float32) -> BodyPose:
        g = torch.Generator().manual_seed(seed)

        def draw(*shape: int) -> Tensor:
            return (size * torch.randn(*shape, generator=g)).to(dtype)

        return BodyPose(
            draw(3), draw(21, 3), draw(15, 3), draw(15, 3), draw(3), torch.zeros(2, dtype=dtype)
        )

    return make
