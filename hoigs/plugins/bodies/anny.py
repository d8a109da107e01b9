"""body:anny: the built-in body, an adult of the open Anny model with ten shape directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.body import BODY_JOINT_PARTS, BodyModel, BodyOutput, BodySurface
from hoigs.core.config import ComponentConfig
from hoigs.core.moment import BodyPose
from hoigs.core.rotation import matrices_to_axis_angle
from hoigs.core.skinning import joint_transforms, skin
from hoigs.plugins.bodies.sampling import sample_surface

ASSET = Path(__file__).parent / "data" / "anny_body.npz"


class AnnyConfig(ComponentConfig):
    """The built-in body has no settings."""


class AnnyBody(BodyModel):
    """13,718 vertices, 52 joints in SMPL-X's order, ten shape directions; CC0 (data/NOTICE.md).

    The asset rests in an A-pose; it is turned into the T-pose once, here, so that zero means to
    this body what it means to SMPL-X. Shape directions turn with it, which keeps `shaped` linear.

    Attributes:
        uv: texture coordinates [U, 2]. face_uv: their indices by face corner [F, 3].
    """

    template: Tensor
    joints: Tensor
    shape_directions: Tensor
    joint_shape_directions: Tensor
    faces: Int[Tensor, "F 3"]
    skinning_weights: Float[Tensor, "V J"]
    vertex_parts: Int[Tensor, " V"]
    uv: Tensor
    face_uv: Tensor

    def __init__(self) -> None:
        super().__init__()
        with np.load(ASSET, allow_pickle=False) as file:
            asset = {key: file[key] for key in file.files}
        self.parents = tuple(int(p) for p in asset["parents"])
        self.joint_names = tuple(str(n) for n in asset["joint_names"])
        self.num_betas = asset["shapedirs"].shape[0]
        weights = _dense_weights(asset["weights"], asset["weight_joints"], len(self.parents))
        parts = torch.tensor([*BODY_JOINT_PARTS, *[8] * 15, *[9] * 15])
        to_t_pose = _t_pose_transforms(asset, self.parents)
        turn = to_t_pose[:, :3, :3]
        blend = torch.einsum("vj,jab->vab", weights, turn)
        rest, joints = _double(asset["v_rest"]), _double(asset["joints"])
        shapes, joint_shapes = _double(asset["shapedirs"]), _double(asset["joint_shapedirs"])
        moved_joints = (turn @ joints[..., None])[..., 0] + to_t_pose[:, :3, 3]
        tensors = {
            "template": skin(rest, to_t_pose, weights),
            "joints": moved_joints,
            "shape_directions": torch.einsum("vab,kvb->kva", blend, shapes),
            "joint_shape_directions": torch.einsum("jab,kjb->kja", turn, joint_shapes),
            "skinning_weights": weights,
            "uv": _double(asset["uv"]),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor.float(), persistent=False)
        indices = {
            "faces": torch.from_numpy(asset["faces"].astype(np.int64)),
            "face_uv": torch.from_numpy(asset["face_uv"].astype(np.int64)),
            "vertex_parts": parts[weights.argmax(1)],
        }
        for name, tensor in indices.items():
            self.register_buffer(name, tensor, persistent=False)

    def shaped(
        self, betas: Float[Tensor, "*batch B"]
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch J 3"]]:
        vertices = self.template + torch.einsum("...k,kva->...va", betas, self.shape_directions)
        joints = self.joints + torch.einsum("...k,kja->...ja", betas, self.joint_shape_directions)
        return vertices, joints

    def skinning_transforms(self, pose: BodyPose) -> Float[Tensor, "*batch J 4 4"]:
        rotations = self.joint_rotations(pose)
        offset = torch.einsum("...k,kja->...ja", pose.betas, self.joint_shape_directions)
        joints = (self.joints + offset).expand(rotations.shape)
        return joint_transforms(rotations, joints, self.parents, pose.transl)

    def forward(self, pose: BodyPose) -> BodyOutput:
        vertices, joints = self.shaped(pose.betas)
        transforms = self.skinning_transforms(pose)
        posed = (transforms[..., :3, :3] @ joints[..., None])[..., 0] + transforms[..., :3, 3]
        return BodyOutput(skin(vertices, transforms, self.skinning_weights), posed)

    def surface(
        self, count: int | None = None, betas: Float[Tensor, " B"] | None = None, seed: int = 0
    ) -> BodySurface:
        vertices, _ = self.shaped(self.template.new_zeros(self.num_betas) if betas is None else betas)
        return sample_surface(
            vertices, self.faces, self.skinning_weights, self.vertex_parts, count, seed
        )


def _double(array: np.ndarray) -> Tensor:
    return torch.from_numpy(array.astype(np.float64))


def _dense_weights(weights: np.ndarray, joints: np.ndarray, count: int) -> Float[Tensor, "V J"]:
    """Top-4 skinning weights as a matrix whose rows sum to 1."""
    dense = torch.zeros(len(weights), count, dtype=torch.float64)
    dense.scatter_add_(1, torch.from_numpy(joints.astype(np.int64)), _double(weights))
    return dense / dense.sum(1, keepdim=True)


def _t_pose_transforms(
    asset: dict[str, np.ndarray], parents: tuple[int, ...]
) -> Float[Tensor, "J 4 4"]:
    """Transforms from the asset's A-pose to the T-pose (`tpose_rot` turns each bone globally)."""
    turns = _double(asset["tpose_rot"])
    local = [turns[j] if p < 0 else turns[p].mT @ turns[j] for j, p in enumerate(parents)]
    rotations = matrices_to_axis_angle(torch.stack(local))
    return joint_transforms(
        rotations, _double(asset["joints"]), parents, torch.zeros(3, dtype=torch.float64)
    )
