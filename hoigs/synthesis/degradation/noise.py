"""Errors of a real pipeline, added to exact cameras, masks, depth, poses and tracks.

With its settings at zero each function returns its input.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.synthesis.config import NoiseConfig
from hoigs.synthesis.motion.object_script import Track

Array = np.ndarray


def noisy_mask(
    mask: Bool[Array, "H W"], noise: NoiseConfig, rng: np.random.Generator
) -> Bool[Array, "H W"]:
    """Moves the boundary, flips a share of the pixels within 2 px of it, or loses the mask."""
    if rng.uniform() < noise.mask_missing:
        return np.zeros_like(mask)
    if noise.mask_edge_pixels:
        grow = int(rng.integers(-noise.mask_edge_pixels, noise.mask_edge_pixels + 1))
        if grow:
            change = ndimage.binary_dilation if grow > 0 else ndimage.binary_erosion
            mask = change(mask, iterations=abs(grow))
    if noise.mask_boundary == 0:
        return mask
    band = ndimage.binary_dilation(mask, iterations=2) & ~ndimage.binary_erosion(mask, iterations=2)
    return mask ^ (band & (rng.uniform(size=mask.shape) < noise.mask_boundary))


def noisy_depth(
    depth: Float[Array, "H W"], noise: NoiseConfig, rng: np.random.Generator
) -> Float[Array, "H W"]:
    """Scaled, with relative Gaussian noise and holes (0)."""
    out = depth * noise.depth_scale
    if noise.depth_relative:
        out = out * np.maximum(0.05, 1 + noise.depth_relative * rng.normal(size=depth.shape))
    if noise.depth_holes:
        out = np.where(rng.uniform(size=depth.shape) < noise.depth_holes, 0, out)
    return out.astype(np.float32)


def noisy_camera(camera: Camera, noise: NoiseConfig, rng: np.random.Generator) -> Camera:
    """Turned about its own centre and shifted, both Gaussian."""
    if noise.camera_degrees == 0 and noise.camera_metres == 0:
        return camera
    turn = Rotation.from_rotvec(np.radians(noise.camera_degrees) * rng.normal(size=3)).as_matrix()
    viewmat = camera.world_to_camera.double().clone()
    center = camera.center.double() + noise.camera_metres * torch.from_numpy(rng.normal(size=3))
    viewmat[:3, :3] = torch.from_numpy(turn) @ viewmat[:3, :3]
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return replace(camera, world_to_camera=viewmat.to(camera.world_to_camera))


def noisy_poses(poses: BodyPose, noise: NoiseConfig, rng: np.random.Generator) -> BodyPose:
    """Independent Gaussian turns of body joints and shifts of the body, frame by frame; and one
    error of its shape for all frames."""
    if noise.betas:
        off = noise.betas * rng.normal(size=poses.betas.shape)
        poses = poses.replace(betas=poses.betas + torch.from_numpy(off).to(poses.betas))
    if noise.pose_degrees == 0 and noise.pose_metres == 0:
        return poses

    def turned(vectors: torch.Tensor) -> torch.Tensor:
        std = np.radians(noise.pose_degrees)
        turn = torch.from_numpy(std * rng.normal(size=vectors.shape)).to(vectors)
        return matrices_to_axis_angle(
            axis_angle_to_matrices(vectors) @ axis_angle_to_matrices(turn)
        )

    shift = torch.from_numpy(noise.pose_metres * rng.normal(size=poses.transl.shape))
    return poses.replace(
        global_orient=turned(poses.global_orient),
        body=turned(poses.body),
        transl=poses.transl + shift.to(poses.transl),
    )


def noisy_track(track: Track, noise: NoiseConfig, rng: np.random.Generator) -> Track:
    """Independent Gaussian turns and shifts, frame by frame."""
    if noise.object_degrees == 0 and noise.object_metres == 0:
        return track
    vectors = np.radians(noise.object_degrees) * rng.normal(size=track.translations.shape)
    return Track(
        track.rotations @ Rotation.from_rotvec(vectors).as_matrix(),
        track.translations + noise.object_metres * rng.normal(size=track.translations.shape),
    )
