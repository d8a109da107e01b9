"""Orbits: closed, small, and with the pivot where it was."""

from __future__ import annotations

import math

import torch

from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.evaluation.measure import orbit_cameras, pivot, turned


def test_pivot_keeps_its_pixel_and_its_distance(model: SceneModel, clip: Clip) -> None:
    base = clip.cameras[4]
    center = pivot(model, clip, clip.moments[4], base)
    pixel, depth = base.project(center)
    for camera in orbit_cameras(clip, model, 12):
        moved, distance = camera.project(center)
        torch.testing.assert_close(moved, pixel, atol=1e-3, rtol=1e-5)
        torch.testing.assert_close(distance, depth, atol=1e-5, rtol=1e-5)
        rotation = camera.world_to_camera[:3, :3]
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3), atol=1e-5, rtol=0)
        assert (camera.width, camera.height) == (base.width, base.height)


def test_swing_is_the_amplitude_and_begins_at_the_frame(model: SceneModel, clip: Clip) -> None:
    path = orbit_cameras(clip, model, 8, amplitude=20, position=1)
    base = clip.cameras[1]
    torch.testing.assert_close(path[0].world_to_camera, base.world_to_camera)
    center = pivot(model, clip, clip.moments[1], base)

    def angle(camera) -> float:
        a, b = base.center - center, camera.center - center
        return math.degrees(math.acos(min(1.0, float(a @ b / (a.norm() * b.norm())))))

    angles = [angle(camera) for camera in path]
    assert max(angles) < 21 and abs(angles[2] - 20) < 0.5 and abs(angles[6] - 20) < 0.5
    assert (path[2].center - path[6].center).norm() > 0.5  # to both sides


def test_pivot_without_a_human_or_anything_that_moves(model: SceneModel, clip: Clip) -> None:
    camera, moment = clip.cameras[0], clip.moments[0]
    both = pivot(model, clip, moment, camera)
    assert abs(float(both[2]) - 2.5) < 0.2  # man and ball stand 2.5 m ahead
    del model.entities["man"], model.entities["ball"]
    wall = pivot(model, clip, moment, camera)
    pixel, depth = camera.project(wall)
    torch.testing.assert_close(pixel, torch.tensor([24.0, 16.0]), atol=1e-3, rtol=0)
    assert abs(float(depth) - 4.0) < 0.3


def test_turned_carries_the_camera_about_a_point(clip: Clip) -> None:
    camera = clip.cameras[0]
    quarter = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    center = torch.tensor([0.0, 0.0, 2.5])
    moved = turned(camera, center, quarter)
    expected = center + quarter @ (camera.center - center)
    torch.testing.assert_close(moved.center, expected, atol=1e-5, rtol=1e-5)


def test_up_is_against_the_image_rows(clip: Clip) -> None:
    torch.testing.assert_close(clip.up(), torch.tensor([0.0, -1.0, 0.0]), atol=1e-5, rtol=0)
