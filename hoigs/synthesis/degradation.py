"""Errors of a real recording: noise of values, damage of files and frames, motion blur."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.synthesis.config import NoiseConfig
from hoigs.synthesis.generate import SyntheticScene, TrueView
from hoigs.synthesis.object_motions import Track
from hoigs.synthesis.textures import to_linear, to_srgb

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


# Faults of whole files and frames: absent images and masks, NaN depth, lost frames.
#
# Each has a random generator of its own, so that no setting changes the draws of another.


def damage(folder: Path, noise: NoiseConfig, seed: int) -> None:
    """Damage a written clip folder in place, except its held-out views and ground truth."""
    for share, pattern, stream in (
        (noise.mask_absent, "masks/*/*.png", 11),
        (noise.frames_absent, "images/*.png", 12),
    ):
        files = sorted(folder.glob(pattern))
        rng = np.random.default_rng([seed, stream])
        for row in rng.permutation(len(files))[: round(share * len(files))]:
            files[row].unlink()
    if noise.depth_nan == 0:
        return
    rng = np.random.default_rng([seed, 13])
    for path in sorted(folder.glob("depth/*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            depth = archive["depth"].copy()
        depth[rng.uniform(size=depth.shape) < noise.depth_nan] = np.nan
        np.savez_compressed(path, depth=depth)


def with_frames_dropped(scene: SyntheticScene) -> SyntheticScene:
    """The scene with single frames lost, never the first, the last or two in a row.

    The clip does not record which. Held-out views of lost frames are lost too.
    """
    kept = frames_kept(scene.config.frames, scene.config.noise.frames_dropped, scene.config.seed)
    if len(kept) == scene.config.frames:
        return scene
    number = {old: new for new, old in enumerate(kept)}
    script = scene.script
    return replace(
        scene,
        config=scene.config.model_copy(update={"frames": len(kept)}),
        poses=scene.poses.map(lambda x: x[kept] if x.dim() > 1 else x),  # betas are shared
        script=replace(
            script,
            track=Track(script.track.rotations[kept], script.track.translations[kept]),
            hold=Track(script.hold.rotations[kept], script.hold.translations[kept]),
            grip=script.grip[kept],
            bend=script.bend[kept],
            squeeze=script.squeeze[kept],
        ),
        cameras=[scene.cameras[i] for i in kept],
        held_out=[(number[f], camera) for f, camera in scene.held_out if f in number],
    )


def frames_kept(count: int, share: float, seed: int) -> list[int]:
    """The frames, of `count`, that are left when about `share` of them are lost."""
    lost: set[int] = set()
    for frame in np.random.default_rng([seed, 14]).permutation(np.arange(1, max(1, count - 1))):
        if len(lost) >= round(share * count):
            break
        if not lost & {frame - 1, frame + 1}:
            lost.add(int(frame))
    return [i for i in range(count) if i not in lost]


# Motion blur: each image is the mean of the frames around it.

Moments = Iterable[tuple[TrueView, list[TrueView]]]


def with_shutter(moments: Moments, frames: int) -> Iterator[tuple[TrueView, list[TrueView]]]:
    """`SyntheticScene.views` with the images of the path's camera blurred over time.

    Masks, depth and held-out views stay those of the middle frame. The ends have fewer frames.

    Args:
        frames: an odd number; 1 changes nothing.
    """
    reach = frames // 2
    if reach == 0:
        yield from moments
        return
    known = list(moments)
    for i, (view, held_out) in enumerate(known):
        window = [other.image for other, _ in known[max(0, i - reach) : i + reach + 1]]
        yield replace(view, image=mean_image(window)), held_out


def mean_image(images: list[UInt8[Array, "H W 3"]]) -> UInt8[Array, "H W 3"]:
    """The mean of sRGB images in linear light, as a sensor adds them."""
    light = np.mean([to_linear(image / 255.0) for image in images], axis=0)
    return np.round(255 * to_srgb(light)).astype(np.uint8)
