"""Body poses and cameras between two others."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.between import blend_cameras, blend_poses
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose


def pose_between(a: BodyPose, b: BodyPose, r: float) -> BodyPose:
    """`blend_poses`, with the axis-angles that are nearer to those of `a`; r in [0, 1]."""
    between = blend_poses(a, b, r)
    return with_rotations(between, nearest_axis_angle(between.rotations, a.rotations))


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
    """`blend_cameras` with the intrinsics of `a`; r in [0, 1]."""
    return replace(a, world_to_camera=blend_cameras(a, b, r).world_to_camera)
