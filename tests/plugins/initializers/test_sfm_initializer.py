"""initializer:sfm on a ball that stands on a floor before a wall, seen from an arc of cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import Moment
from hoigs.plugins.initializers.sfm import SfmInitializer

RADIUS, FRAMES, SIZE = 0.2, 9, 96
CENTER = torch.tensor([0.1, 0.2, 0.0])


class Ball(FrameStore):
    """Mask and depth of the ball, and of the wall z = 1 behind it."""

    def __init__(self, cameras: list[Camera]) -> None:
        self.cameras = cameras

    def image(self, position):
        return torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8)

    def _along(self, position) -> torch.Tensor:
        """Depth of the ball along z; infinite where the ray misses it."""
        camera = self.cameras[position]
        ray = camera.unproject(camera.pixel_grid(), torch.ones(SIZE, SIZE)) - camera.center
        away = camera.center - CENTER
        a, b, c = (ray * ray).sum(-1), (ray * away).sum(-1), away.dot(away) - RADIUS**2
        root = b * b - a * c
        return torch.where(root > 0, (-b - root.clamp_min(0).sqrt()) / a, torch.inf)

    def mask(self, entity, position):
        return torch.isfinite(self._along(position))

    def depth(self, position):
        camera = self.cameras[position]
        ray = camera.unproject(camera.pixel_grid(), torch.ones(SIZE, SIZE)) - camera.center
        wall = (1 - camera.center[2]) / ray[..., 2]
        depth = torch.minimum(self._along(position), torch.where(wall > 0, wall, torch.inf))
        return torch.where(torch.isfinite(depth), depth, 0.0)


@pytest.fixture
def clip() -> Clip:
    g = torch.Generator().manual_seed(0)
    cameras = []
    for i in range(FRAMES):
        angle = 0.9 * (i / (FRAMES - 1) - 0.5)
        eye = torch.tensor([2 * math.sin(angle), 0.6, -2 * math.cos(angle)])
        cameras.append(Camera.look_at(eye, CENTER, width=SIZE, height=SIZE, fov_y=0.8))
    on_ball = torch.nn.functional.normalize(torch.randn(300, 3, generator=g), dim=1)
    wall = torch.rand(600, 3, generator=g) * torch.tensor([3.0, 2, 0]) + torch.tensor([-1.5, -1, 1])
    turn = axis_angle_to_matrices(torch.tensor([0.3, -0.5, 0.2]))
    track = ObjectTrack(
        points=torch.rand(30, 3, generator=g),
        colors=torch.rand(30, 3, generator=g),
        rotations=turn.expand(FRAMES, 3, 3),
        translations=CENTER.expand(FRAMES, 3),
        observed=torch.ones(FRAMES, dtype=torch.bool),
    )
    return Clip(
        name="a ball",
        store=Ball(cameras),
        cameras=cameras,
        moments=[Moment(i / (FRAMES - 1), i) for i in range(FRAMES)],
        kinds={"ball": "object"},
        objects={"ball": track},
        points=torch.cat((CENTER + RADIUS * on_ball, wall)),
        point_colors=torch.rand(900, 3, generator=g),
        split={"train": [i for i in range(FRAMES) if i != 4], "test": [4]},
        depth_kind="metric",
    )


def test_the_balls_points_and_no_others(clip):
    track = SfmInitializer().initialize(clip, "ball")
    assert (track.points.norm(dim=1) - RADIUS).abs().max() < 1e-5
    world = track.points @ track.rotations[2].mT + track.translations[2]
    same = (world[:, None] - clip.points).norm(dim=-1) < 1e-4
    rows = same.float().argmax(1)
    assert same.any(1).all() and (rows < 300).all()
    torch.testing.assert_close(track.colors, clip.point_colors[rows])
    # nearly every point that some cameras see; the far side of it nobody sees
    front = (clip.points[:300, 2] < CENTER[2] - 0.05).nonzero().squeeze(1)
    assert torch.isin(front, rows).float().mean() > 0.95
    assert not torch.isin((clip.points[:300, 2] > CENTER[2] + 0.15).nonzero(), rows).any()


def test_without_depth_masks_alone_decide(clip):
    track = SfmInitializer(SfmInitializer.Config(share=0.9)).initialize(
        replace(clip, depth_kind="none"), "ball"
    )
    away = (track.points.norm(dim=1) - RADIUS).abs()
    assert len(track.points) > 280 and (away < 1e-5).float().mean() > 0.95
    loose = SfmInitializer(SfmInitializer.Config(share=0.1)).initialize(
        replace(clip, depth_kind="none"), "ball"
    )
    assert ((loose.points.norm(dim=1) - RADIUS).abs() > 0.5).sum() > 5  # the wall behind it


def test_errors_speak(clip):
    bare = replace(clip, points=clip.points[300:], point_colors=clip.point_colors[300:])
    with pytest.raises(ValueError, match=r"0 of the clip's 600 scene points lie on ball in 80%"):
        SfmInitializer().initialize(bare, "ball")
    with pytest.raises(ValueError, match="no track of ball"):
        SfmInitializer().initialize(replace(clip, objects={}), "ball")
    track = clip.objects["ball"]
    path = torch.linspace(0, 0.3, FRAMES)[:, None] * torch.tensor([1.0, 0, 0])
    moving = replace(clip, objects={"ball": replace(track, translations=CENTER + path)})
    with pytest.raises(ValueError, match=r"ball moves by 0\.3\d? m, .* use initializer:depth"):
        SfmInitializer().initialize(moving, "ball")
    turning = axis_angle_to_matrices(torch.linspace(0, 2, FRAMES)[:, None] * torch.eye(3)[1])
    moving = replace(clip, objects={"ball": replace(track, rotations=turning)})
    with pytest.raises(ValueError, match="ball moves by"):
        SfmInitializer().initialize(moving, "ball")
    assert (
        len(SfmInitializer(SfmInitializer.Config(max_motion=1.0)).initialize(moving, "ball").points)
        > 50
    )
