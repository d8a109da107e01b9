"""Body poses and cameras between two others."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import (
    axis_angle_to_quats,
    matrices_to_quats,
    quats_to_axis_angle,
    quats_to_matrices,
    slerp,
)
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose


def pose_between(a: BodyPose, b: BodyPose, r: float) -> BodyPose:
    """Joint rotations by SLERP, translation and shape linearly; r in [0, 1]."""
    turned = quats_to_axis_angle(
        slerp(axis_angle_to_quats(a.rotations), axis_angle_to_quats(b.rotations), r)
    )
    turned = nearest_axis_angle(turned, a.rotations)
    return with_rotations(a, turned).replace(
        transl=torch.lerp(a.transl, b.transl, r), betas=torch.lerp(a.betas, b.betas, r)
    )


def with_rotations(pose: BodyPose, rotations: Float[Tensor, "52 3"]) -> BodyPose:
    """`pose` with other axis-angles, ordered as `BodyPose.rotations`."""
    return pose.replace(
        global_orient=rotations[0],
        body=rotations[1:22],
        left_hand=rotations[22:37],
        right_hand=rotations[37:],
    )


def nearest_axis_angle(
    vectors: Float[Tensor, "J 3"], reference: Float[Tensor, "J 3"]
) -> Float[Tensor, "J 3"]:
    """Of the two axis-angles of each rotation (below and above pi) the one nearer to `reference`.

    Corrections that are added to axis-angles were learned for the neighbours' vector; near half a
    turn they would act in the opposite direction on the other one.
    """
    angle = vectors.norm(dim=-1, keepdim=True)
    other = vectors - 2 * math.pi * vectors / angle.clamp_min(1e-6)
    nearer = (other - reference).norm(dim=-1) < (vectors - reference).norm(dim=-1)
    return torch.where(nearer[:, None] & (angle > 1e-3), other, vectors)


def camera_between(a: Camera, b: Camera, r: float) -> Camera:
    """Rotation by SLERP, centre linearly, intrinsics of `a`; r in [0, 1]."""
    quats = [matrices_to_quats(c.world_to_camera[:3, :3]) for c in (a, b)]
    R = quats_to_matrices(slerp(quats[0], quats[1], r))
    viewmat = a.world_to_camera.clone()
    viewmat[:3, :3] = R
    viewmat[:3, 3] = -R @ torch.lerp(a.center, b.center, r)
    return replace(a, world_to_camera=viewmat)
