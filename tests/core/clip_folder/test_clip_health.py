"""Every fault that training goes on with is named, and a clean clip has none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hoigs.core.clip_folder import health
from hoigs.core.clip_folder.health import depth_factor, examine, raggedness
from hoigs.core.errors import ClipError
from hoigs.core.reporting import Diagnostic, ranges
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment

FRAMES, SIZE = 40, 64
DISC = torch.from_numpy(np.hypot(*(np.mgrid[0:SIZE, 0:SIZE] - 32)) < 14)


class Wall(FrameStore):
    """A disc before a wall that is 4 m away."""

    def __init__(self) -> None:
        self.masks = [DISC.clone() for _ in range(FRAMES)]
        self.depths = [torch.full((SIZE, SIZE), 4.0) for _ in range(FRAMES)]

    def image(self, position: int) -> Tensor:
        del position
        return torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8)

    def mask(self, entity: str, position: int) -> Tensor:
        del entity
        return self.masks[position]

    def depth(self, position: int) -> Tensor | None:
        return self.depths[position]


def swaying(times: Tensor) -> BodyPose:
    pose = BodyPose.zeros(len(times))
    sway = torch.sin(3 * times)[:, None]
    body = pose.body + 0.4 * sway[..., None] * torch.tensor([0.0, 0.3, 1.0])
    return pose.replace(body=body, transl=torch.cat((0.2 * sway, sway * 0, sway * 0), 1))


def clip_at(times: Tensor) -> Clip:
    """Camera, body and box as functions of time, filmed at these times; 0 to 1 if evenly."""
    cameras, frames = [], len(times)
    for t in times.tolist():
        eye = torch.tensor([0.5 * math.sin(t), 0.1, 0.1 * t])
        at = torch.tensor([0.0, 0.0, 4.0])
        look = Camera.look_at(eye, at, width=SIZE, height=SIZE, fov_y=0.8, up=(0.0, -1.0, 0.0))
        view = torch.eye(4)
        view[:3, 3] = -eye
        cameras.append(replace(look, world_to_camera=view))
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=generator) * torch.tensor([3.0, 3.0, 0.0])
    points += torch.tensor([-1.5, -1.5, 4.0])
    box = ObjectTrack(
        torch.ones(1, 3),
        torch.zeros(1, 3),
        torch.eye(3).repeat(frames, 1, 1),
        torch.stack((times, 0.3 * torch.cos(2 * times), times * 0), 1),
        torch.ones(frames, dtype=torch.bool),
    )
    return Clip(
        "wall",
        Wall(),
        cameras,
        [Moment(i / (frames - 1), i) for i in range(frames)],
        kinds={"ann": "human"},
        bodies={"ann": BodyTrack("body:x", swaying(times))},
        objects={"box": box},
        points=points,
        point_colors=torch.zeros(3000, 3),
        split={"train": list(range(frames)), "test": []},
        depth_kind="metric",
    )


@pytest.fixture
def clip() -> Clip:
    """Depth is exact: the camera does not turn, and the wall is at z = 4."""
    made = clip_at(torch.linspace(0, 1, FRAMES))
    assert isinstance(made.store, Wall)
    made.store.depths = [torch.full((SIZE, SIZE), 4.0 - float(c.center[2])) for c in made.cameras]
    return made


def kinds(clip: Clip) -> list[str]:
    return [fault.kind for fault in examine(clip)]


def only(clip: Clip) -> Diagnostic:
    (fault,) = examine(clip)
    return fault


def test_a_clean_clip_has_no_fault(clip: Clip) -> None:
    assert examine(clip) == []


def test_empty_and_full_masks(clip: Clip) -> None:
    for p in (3, 7, 8, 9):
        clip.store.masks[p] = torch.zeros_like(DISC)
    clip.store.masks[20] = torch.ones_like(DISC)
    empty, full = examine(clip)
    assert empty.kind == "empty-masks" and empty.frames == (3, 7, 8, 9)
    assert 'masks of "ann" are empty in frames 3, 7-9 (4 of 40)' in str(empty)
    assert "make them again" in empty.do
    assert full.kind == "full-masks" and full.frames == (20,) and "frames 20" in full.what


def test_masks_that_are_not_known_are_not_called_empty(clip: Clip) -> None:
    clip.store.masks[3] = torch.zeros_like(DISC)
    clip.store.mask_known = lambda entity, position: position != 3
    assert examine(clip) == []


def test_ragged_masks(clip: Clip) -> None:
    from hoigs.synthesis import NoiseConfig
    from hoigs.synthesis.degradation import noisy_mask

    rng, noise = np.random.default_rng(0), NoiseConfig(mask_boundary=0.2)
    rough = [torch.from_numpy(noisy_mask(DISC.numpy(), noise, rng)) for _ in range(FRAMES)]
    assert raggedness(DISC) < 0.03
    assert 0.14 < float(np.median([raggedness(m) for m in rough])) < 0.24
    clip.store.masks = rough
    fault = only(clip)
    assert fault.kind == "ragged-masks" and '"ann"' in fault.what and "smooth them" in fault.do
    assert raggedness(torch.zeros_like(DISC)) == 0


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_depth_unlike_the_points(clip: Clip, factor: float) -> None:
    clip.store.depths = [factor * d for d in clip.store.depths]
    fault = only(clip)
    assert fault.kind == "depth-scale"
    assert f"{factor:.2f} times as deep as the scene points" in fault.what
    assert f"multiply them by {1 / factor:.2f}" in fault.do and "depth_fit=auto" in fault.do
    assert depth_factor(clip) == pytest.approx(factor, rel=0.02)
    assert kinds(replace(clip, depth_kind="affine-disparity")) == []


def test_a_default_of_float64_changes_no_factor(clip: Clip) -> None:
    torch.set_default_dtype(torch.float64)
    try:
        assert depth_factor(clip) == 1.0
    finally:
        torch.set_default_dtype(torch.float32)


def test_points_behind_others_do_not_hide_the_right_scale(clip: Clip) -> None:
    behind = clip.points[:1200] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 6.0])
    points = torch.cat((clip.points, behind))
    assert kinds(replace(clip, points=points, point_colors=torch.zeros_like(points))) == []


def test_holes_in_depth(clip: Clip) -> None:
    holes = torch.arange(SIZE) % 2 == 0
    clip.store.depths = [d * holes for d in clip.store.depths]
    fault = only(clip)
    assert (
        fault.kind == "depth-holes" and "50 % of the depth maps' pixels are unknown" in fault.what
    )


def test_poses_that_jitter(clip: Clip) -> None:
    poses = clip.bodies["ann"].poses
    noise = math.radians(3) * torch.randn(poses.body.shape, generator=torch.Generator())
    noisy = replace(clip.bodies["ann"], poses=poses.replace(body=poses.body + noise))
    fault = only(replace(clip, bodies={"ann": noisy}))
    assert fault.kind == "pose-noise" and '"ann" jitter' in fault.what
    assert "train.rates.pose" in fault.do


def test_a_body_filmed_at_few_frames_a_second_does_not_jitter() -> None:
    """Its joints are degrees off the middle of their neighbours, but on a smooth path."""
    times = torch.linspace(0, 1, 12)
    clip = clip_at(times)
    pose = clip.bodies["ann"].poses
    wide = pose.body + 0.6 * torch.sin(9 * times)[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
    moving = replace(clip.bodies["ann"], poses=pose.replace(body=wide))
    off = wide[1:-1] - 0.5 * (wide[2:] + wide[:-2])
    assert float(torch.rad2deg(off.norm(dim=-1).median())) > 4
    assert "pose-noise" not in kinds(replace(clip, bodies={"ann": moving}))


def test_small_masks_and_few_poses_are_not_judged(clip: Clip) -> None:
    clip.store.masks = [m & (torch.rand(m.shape) < 0.2) for m in clip.store.masks]  # 120 pixels
    assert examine(clip) == []
    noise = 0.2 * torch.randn(40, 22, 3, generator=torch.Generator().manual_seed(0))
    assert list(health._jitter("ann", noise)) and not list(health._jitter("ann", noise[:11]))


@pytest.mark.parametrize(
    ("part", "who"), [("points", "the scene"), ("body", '"ann"'), ("box", '"box"')]
)
def test_what_no_camera_sees(clip: Clip, part: str, who: str) -> None:
    """1,000 km away; behind all cameras, or beside their pictures, is alike."""
    body, box = clip.bodies["ann"], clip.objects["box"]
    for shift in ((0.0, 0.0, 1e6), (0.0, 0.0, -9.0), (40.0, 0.0, 4.0)):
        away = torch.tensor(shift)
        poses = body.poses.replace(transl=body.poses.transl + away)
        moved = {
            "points": {"points": clip.points * torch.tensor([1.0, 1.0, -1.0])},
            "body": {"bodies": {"ann": replace(body, poses=poses)}},
            "box": {"objects": {"box": replace(box, translations=box.translations + away)}},
        }[part]
        broken = replace(clip, depth_kind="none", **moved)
        fault = only(broken)
        assert fault.kind == "unseen" and f"no camera sees {who}" in fault.what
        with pytest.raises(ClipError, match=f"wall cannot be trained on:\n.*{who}.*\n.*--allow-f"):
            health.require_useful(broken, [fault])


@pytest.mark.parametrize("lost", [[7], [7, 9], [5, 20, 31]])
def test_frames_lost_from_the_video(lost: list[int]) -> None:
    times = torch.linspace(0, 1, FRAMES)
    left = [i for i in range(FRAMES) if i not in lost]
    clip = clip_at(times[left])
    clip.store.depths = [torch.full((SIZE, SIZE), 4.0 - float(c.center[2])) for c in clip.cameras]
    fault = only(clip)
    assert fault.kind == "missing-frames"
    assert list(fault.frames) == [left.index(i - 1) for i in lost]


def test_a_start_from_rest_is_no_gap(clip: Clip) -> None:
    begins = (torch.linspace(-1, 1, FRAMES)).clamp_min(0)
    clip = clip_at(begins)
    clip.store.depths = [torch.full((SIZE, SIZE), 4.0 - float(c.center[2])) for c in clip.cameras]
    assert kinds(clip) == []


def test_what_moves_on_evenly_speaks_against_a_gap() -> None:
    """Cups of a shell game set off together while the hands go on."""
    even = torch.linspace(0, 1, FRAMES)[:, None]
    jumping = even + 0.1 * (torch.arange(FRAMES)[:, None] > 7)
    votes = [int(health._standing_out(path)[7]) for path in (jumping, even, 0 * even)]
    assert votes == [2, -1, 0]


def test_an_unsteady_hand_is_no_gap(clip: Clip) -> None:
    generator = torch.Generator().manual_seed(2)
    cameras = []
    for camera in clip.cameras:
        shake = 0.02 * torch.randn(3, generator=generator)
        cameras.append(camera.moved(torch.zeros(3), shake))
    assert "missing-frames" not in kinds(replace(clip, cameras=cameras))


def test_what_the_reader_let_pass_comes_first(clip: Clip) -> None:
    passed = Diagnostic("nan-depth", "depth/00003.npz", "write 0", (3,))
    assert examine(replace(clip, faults=[passed]))[0] is passed
    assert passed.to_dict()["frames"] == [3]
    assert ranges([9, 1, 2, 3, 7]) == "1-3, 7, 9"
    assert ranges(range(0, 40, 2), most=2) == "0, 2, …"
