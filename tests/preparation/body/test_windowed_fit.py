"""The body fit in windows: one shape, and poses that follow on from window to window."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from test_body_fit import body, camera, joint_errors, seen_by

from hoigs.core.maths.frame_times import Chunking
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.fit import fit_body, spread
from hoigs.preparation.body.fit_problem import FitOptions, Observations
from hoigs.preparation.body.fitted import BodyFit
from hoigs.preparation.body.kinematics import NormalEquations
from hoigs.preparation.body.landmarks import Landmarks

FRAMES, CHUNKING, QUICK = 48, Chunking(24, 10), FitOptions(steps=20)


def truth() -> BodyPose:
    """Arms and a knee swing, and the person sways, for two seconds."""
    t = torch.arange(FRAMES) / 30
    pose = BodyPose.zeros(FRAMES)
    angles, orient, transl = pose.body.clone(), pose.global_orient.clone(), pose.transl.clone()
    swing, sway = (2 * math.pi * t / 1.3).sin(), (2 * math.pi * t / 1.7).cos()
    orient[:, 0], transl[:, 2] = torch.pi, 3.0
    angles[:, 15, 2], angles[:, 16, 2] = -1.1 + 0.3 * swing, 1.1 + 0.3 * sway
    angles[:, 1, 0], angles[:, 4, 0] = -0.45 + 0.45 * swing, 0.6 - 0.6 * swing
    transl[:, 0] = 0.2 * sway
    return pose.replace(global_orient=orient, body=angles, transl=transl)


def noisy(cameras: list[Camera]) -> Landmarks:
    """Landmarks that are 2 pixels and 2 cm off."""
    seen, generator = seen_by(cameras, truth()), torch.Generator().manual_seed(0)
    image, world = seen.image.clone(), seen.world.clone()
    image[..., :2] += 2 * torch.randn(image[..., :2].shape, generator=generator)
    world += 0.02 * torch.randn(world.shape, generator=generator)
    return Landmarks(image, world)


@cache
def fits() -> tuple[BodyFit, BodyFit]:
    """Of all frames at once, and in windows."""
    cameras = [camera()] * FRAMES
    whole = fit_body(body(), Observations(noisy(cameras), cameras), options=QUICK)
    windows = fit_body(
        body(), Observations(noisy(cameras), cameras), options=QUICK, chunking=CHUNKING
    )
    return whole, windows


def test_windows_give_what_the_whole_clip_gives() -> None:
    whole, windowed = fits()
    assert windowed.report["windows"] == 3
    assert windowed.poses.betas.shape == (10,), "one shape"
    assert len(windowed.poses.transl) == len(windowed.residual_px) == FRAMES
    assert (
        joint_errors(windowed.poses, truth()).mean()
        < joint_errors(whole.poses, truth()).mean() + 0.003
    )
    for name in ("landmark_error_px", "landmark_noise_px"):
        assert windowed.report[name] == pytest.approx(whole.report[name], rel=0.15)
    assert windowed.report["frames_with_landmarks"] == FRAMES


def test_windows_meet_where_they_join() -> None:
    whole, windowed = fits()
    assert [joint.frame for joint in windowed.joints] == [14, 27]
    for joint in windowed.joints:
        assert joint.metres <= 0.01
        assert joint.degrees <= 2
    # and the pose steps no farther there than a fit of all frames does
    with torch.no_grad():
        at, smooth = (body()(fit.poses).joints[:, :22] for fit in (windowed, whole))
    for joint in windowed.joints:
        step, usual = (x[joint.frame] - x[joint.frame - 1] for x in (at, smooth))
        assert (step - usual).norm(dim=-1).max() < 0.01


def test_a_gap_in_the_landmarks_across_a_joint_is_carried() -> None:
    cameras = [camera()] * FRAMES
    seen = noisy(cameras)
    image = seen.image.clone()
    image[12:17] = torch.nan
    fit = fit_body(
        body(), Observations(replace(seen, image=image), cameras), options=QUICK, chunking=CHUNKING
    )
    assert joint_errors(fit.poses, truth()).max() < 0.2
    assert fit.residual_px.isnan().nonzero()[:, 0].tolist() == list(range(12, 17))


def test_one_scale_of_the_world_serves_all_windows() -> None:
    path = torch.linspace(-0.6, 0.6, FRAMES).tolist()
    metric = [camera((x, 0.0, 0.0)) for x in path]
    seen = seen_by(metric, truth().replace(transl=truth().transl[:1].expand(FRAMES, 3)))
    halved = [c.scaled(0.5) for c in metric]
    fit = fit_body(
        body(), Observations(seen, halved), options=replace(QUICK, scale=True), chunking=CHUNKING
    )
    assert fit.scene_scale == pytest.approx(2, rel=0.1)
    assert max(joint.metres for joint in fit.joints) <= 0.01


def test_a_clip_no_longer_than_a_window_is_fitted_at_once() -> None:
    cameras = [camera()] * 9
    seen = noisy([camera()] * FRAMES).rows(slice(0, 9))
    one = fit_body(
        body(), Observations(seen, cameras), options=FitOptions(steps=5), chunking=CHUNKING
    )
    other = fit_body(body(), Observations(seen, cameras), options=FitOptions(steps=5))
    assert torch.equal(one.poses.transl, other.poses.transl)
    assert not one.joints


def test_frames_that_stand_for_all_come_from_all_over() -> None:
    frames = torch.arange(1000)
    some = spread(frames, 100)
    assert len(some) == 100
    starts = some[torch.cat((torch.tensor([True]), some.diff() > 1))]
    assert len(starts) == 10, "in stretches, so that motion is seen"
    assert int(starts[0]) < 100
    assert int(starts[-1]) > 900
    assert spread(torch.arange(5), 32).tolist() == [0, 1, 2, 3, 4]


def test_held_frames_take_no_step() -> None:
    equations, generator = NormalEquations(6, 4, 0), torch.Generator().manual_seed(0)
    by_frame = torch.rand(6, 9, 4, generator=generator).double()
    residuals = torch.rand(6, 9, generator=generator).double()
    none = torch.zeros(6, 9, 0).double()
    equations.add(residuals, torch.ones_like(residuals), by_frame, none)
    factors = torch.tensor([[1.0, -2.0, 1.0]] * 4).double()
    equations.add_accelerations(residuals[:4], torch.ones(4, 9).double(), factors, by_frame, none)
    equations.hold(2)
    found = equations.step(0.0)
    assert found is not None
    assert not found[0][:2].any()
    assert found[0][2:].abs().min() > 0
