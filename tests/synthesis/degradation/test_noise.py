from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.synthesis import NoiseConfig
from hoigs.synthesis.degradation import (
    noisy_camera,
    noisy_depth,
    noisy_mask,
    noisy_poses,
    noisy_track,
)
from hoigs.synthesis.object_motions import Track

DISC = np.hypot(*(np.mgrid[0:60, 0:60] - 30)) < 18
CAMERA = Camera.look_at(
    torch.tensor([0.0, 1.0, 3.0]), torch.tensor([0.0, 1.0, 0.0]), width=64, height=64, fov_y=0.8
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def _angle(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    cosine = ((first.mT @ second).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))


def test_without_noise_everything_is_returned_as_it_was(rng: np.random.Generator) -> None:
    clean = NoiseConfig(points_metres=0)
    depth = np.full((4, 4), 2.0, np.float32)
    poses = BodyPose.zeros(3)
    track = Track(np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))
    assert noisy_mask(DISC, clean, rng) is DISC
    np.testing.assert_array_equal(noisy_depth(depth, clean, rng), depth)
    assert noisy_camera(CAMERA, clean, rng) is CAMERA
    assert noisy_poses(poses, clean, rng) is poses
    assert noisy_track(track, clean, rng) is track


def test_masks_change_at_their_boundary_only(rng: np.random.Generator) -> None:
    noisy = noisy_mask(DISC, NoiseConfig(mask_boundary=0.2), rng)
    flipped = noisy ^ DISC
    distance = np.abs(np.hypot(*(np.mgrid[0:60, 0:60] - 30)) - 18)
    assert flipped.any() and distance[flipped].max() < 3.5
    band = distance < 1.5
    assert 0.12 < flipped[band].mean() < 0.28


def test_masks_go_missing_at_their_rate(rng: np.random.Generator) -> None:
    gone = [not noisy_mask(DISC, NoiseConfig(mask_missing=0.3), rng).any() for _ in range(300)]
    assert 0.2 < np.mean(gone) < 0.4


def test_depth_noise_is_relative_and_holes_are_zero(rng: np.random.Generator) -> None:
    depth = np.full((100, 100), 2.0, np.float32)
    noisy = noisy_depth(depth, NoiseConfig(depth_relative=0.05, depth_holes=0.1), rng)
    assert noisy.dtype == np.float32
    assert (noisy == 0).mean() == pytest.approx(0.1, abs=0.02)
    assert noisy[noisy > 0].std() == pytest.approx(0.1, rel=0.05)


def test_cameras_turn_and_shift_by_their_std(rng: np.random.Generator) -> None:
    noise = NoiseConfig(camera_degrees=2.0, camera_metres=0.03)
    noisy = [noisy_camera(CAMERA, noise, rng) for _ in range(400)]
    shift = torch.stack([c.center for c in noisy]) - CAMERA.center
    assert float(shift.std()) == pytest.approx(0.03, rel=0.1)
    turns = torch.stack([c.world_to_camera[:3, :3] for c in noisy])
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(400, 3, 3), atol=1e-5, rtol=0)
    angle = _angle(CAMERA.world_to_camera[:3, :3].expand(400, 3, 3), turns)
    assert float(angle.square().mean().sqrt()) == pytest.approx(2.0 * 3**0.5, rel=0.1)
    only_turned = noisy_camera(CAMERA, NoiseConfig(camera_degrees=2.0), rng)
    torch.testing.assert_close(only_turned.center, CAMERA.center, atol=1e-5, rtol=0)


def test_poses_turn_by_their_std_and_keep_hands(rng: np.random.Generator) -> None:
    poses = BodyPose.zeros(200)
    poses = poses.replace(body=poses.body + 0.4)
    noisy = noisy_poses(poses, NoiseConfig(pose_degrees=3.0, pose_metres=0.02), rng)
    angle = _angle(axis_angle_to_matrices(poses.body), axis_angle_to_matrices(noisy.body))
    assert float(angle.square().mean().sqrt()) == pytest.approx(3.0 * 3**0.5, rel=0.05)
    assert float((noisy.transl - poses.transl).std()) == pytest.approx(0.02, rel=0.1)
    assert torch.equal(noisy.left_hand, poses.left_hand)


def test_tracks_turn_and_shift(rng: np.random.Generator) -> None:
    track = Track(np.tile(np.eye(3), (300, 1, 1)), np.zeros((300, 3)))
    noisy = noisy_track(track, NoiseConfig(object_degrees=4.0, object_metres=0.05), rng)
    assert noisy.translations.std() == pytest.approx(0.05, rel=0.1)
    angle = _angle(torch.from_numpy(track.rotations), torch.from_numpy(noisy.rotations))
    assert float(angle.square().mean().sqrt()) == pytest.approx(4.0 * 3**0.5, rel=0.1)
