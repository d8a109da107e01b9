"""The world of a clip turned to the axes of other programs."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_quats,
    multiply_quats,
)
from hoigs.core.maths.spherical_harmonics import rotate_sh
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians

Up = Literal["clip", "y", "z"]
AXES: dict[Up, str] = {
    "clip": "the world of the clip; cameras are OpenCV's (x right, y down, z forward)",
    "y": "right-handed, y up: the world of the clip, turned so that the mean upward direction of "
    "its cameras is +y",
    "z": "right-handed, z up: the world of the clip, turned so that the mean upward direction of "
    "its cameras is +z",
}


def world_turn(clip: Clip, up: Up) -> Float[Tensor, "3 3"]:
    """The rotation from the world of the clip to one in which `up` is upward; float32."""
    if up == "clip":
        return torch.eye(3)
    target = torch.tensor((0.0, 1.0, 0.0) if up == "y" else (0.0, 0.0, 1.0))
    return rotation_between(clip.up().cpu().float(), target)


def rotation_between(a: Float[Tensor, " 3"], b: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes the unit vector `a` to `b`."""
    axis = torch.linalg.cross(a, b)
    sine, cosine = axis.norm(), torch.dot(a, b)
    if sine < 1e-6:
        if cosine > 0:
            return torch.eye(3)
        axis, sine = torch.linalg.cross(a, a.roll(1) + torch.tensor((0.3, 0.0, 0.0))), sine * 0
        axis = axis / axis.norm()
        return axis_angle_to_matrices(axis * torch.pi)
    return axis_angle_to_matrices(axis / sine * torch.atan2(sine, cosine))


def turned_gaussians(gaussians: Gaussians, turn: Float[Tensor, "3 3"]) -> Gaussians:
    """Gaussians of a world that is rotated: means, orientations and SH colours."""
    if torch.equal(turn, torch.eye(3).to(turn)):
        return gaussians
    turn = turn.to(gaussians.means)
    quat = matrices_to_quats(turn)
    return gaussians.replace(
        means=gaussians.means @ turn.mT,
        quats=multiply_quats(quat.expand_as(gaussians.quats), gaussians.quats),
        sh=rotate_sh(gaussians.sh, turn),
    )
