"""The world of a clip turned to the axes of other programs."""

from __future__ import annotations

from dataclasses import dataclass
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
    "y": "right-handed, y up: the world of the clip, turned so that its up is +y and moved along "
    "it so that its floor is y = 0",
    "z": "right-handed, z up: the world of the clip, turned so that its up is +z and moved along "
    "it so that its floor is z = 0",
}


@dataclass(frozen=True)
class Move:
    """A rigid motion of the world: x becomes turn x + shift, metres."""

    turn: Float[Tensor, "3 3"]
    shift: Float[Tensor, " 3"]

    def points(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points of the clip's world in the new one."""
        return points @ self.turn.to(points).mT + self.shift.to(points)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in the new world: means, orientations and SH colours."""
        means, quats, sh = gaussians.means, gaussians.quats, gaussians.sh
        if not torch.equal(self.turn, torch.eye(3)):
            turn = self.turn.to(means)
            quats = multiply_quats(matrices_to_quats(turn).expand_as(quats), quats)
            sh = rotate_sh(sh, turn)
        return gaussians.replace(means=self.points(means), quats=quats, sh=sh)


def world_move(clip: Clip, up: Up) -> Move:
    """From the world of the clip to one in which `up` is upward and the floor is at 0, float32.

    Where the clip knows no floor, its origin stays.
    """
    if up == "clip":
        return Move(torch.eye(3), torch.zeros(3))
    target = torch.tensor((0.0, 1.0, 0.0) if up == "y" else (0.0, 0.0, 1.0))
    turn = rotation_between(clip.world.up_vector(), target)
    return Move(turn, -(clip.world.floor or 0.0) * target)


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
