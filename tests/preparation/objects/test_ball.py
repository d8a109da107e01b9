"""A ball's disc: its edge found, its distance metric, its gaps filled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import BALL, FRAMES, HEIGHT, WIDTH, masks

from hoigs.core.maths.frame_times import smooth
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.cameras.camera_track import pinhole, static_cameras
from hoigs.preparation.objects.ball import ball_centers, load_ball, outline_rays, refine_ball
from hoigs.preparation.video.frames import Choice, VideoFrames
from hoigs.preparation.video.source import SourceError


def truth() -> np.ndarray:
    return np.array([BALL(i) for i in range(FRAMES)])


def test_gaps_are_filled_and_marked(tiny_source: Path) -> None:
    ball = load_ball(
        tiny_source / "ball_track.npz", VideoFrames(tiny_source / "video.mp4"), Undistortion()
    )
    assert ball.observed.tolist() == [i != 5 for i in range(FRAMES)]
    np.testing.assert_allclose(ball.centers, truth()[:, :2], atol=1e-4)
    np.testing.assert_allclose(ball.radii, truth()[:, 2], atol=0.05)
    disc = ball.disc(3, WIDTH, HEIGHT)
    assert (disc != masks(3)[1]).sum() <= 4


def test_half_width_halves_the_disc(tiny_source: Path) -> None:
    video = VideoFrames(tiny_source / "video.mp4", WIDTH // 2, Choice(every=2))
    ball = load_ball(tiny_source / "ball_track.npz", video, Undistortion())
    np.testing.assert_allclose(ball.centers, truth()[::2, :2] / 2, atol=1e-4)


def test_refinement_finds_the_round_edge(tiny_source: Path) -> None:
    shifted = truth() + np.random.default_rng(0).uniform(-0.7, 0.7, (FRAMES, 3))
    np.savez(tiny_source / "ball_track.npz", xyr=shifted)
    video = VideoFrames(tiny_source / "video.mp4")
    rough = load_ball(tiny_source / "ball_track.npz", video, Undistortion())
    fine = refine_ball(rough, video)

    def error(ball: object) -> float:
        return float(np.abs(ball.centers - truth()[:, :2]).mean())  # type: ignore[attr-defined]

    assert error(fine) < 0.5 * error(rough)
    assert np.abs(fine.radii - truth()[:, 2]).mean() < 0.35


def test_distance_is_metric(tiny_source: Path) -> None:
    video = VideoFrames(tiny_source / "video.mp4")
    ball = load_ball(tiny_source / "ball_track.npz", video, Undistortion())
    cameras = static_cameras(video, pinhole(video, 0.8 * WIDTH)).cameras
    centers = ball_centers(ball, cameras, radius=0.11)
    turns = np.linspace(0, 2 * np.pi, 9)
    ring = np.stack((np.cos(turns), np.sin(turns)), -1)
    for center, xy, r in zip(centers, ball.centers, ball.radii, strict=True):
        rays = torch.from_numpy(outline_rays(xy + r * ring, cameras[0])).float()
        passes = torch.linalg.cross(rays, center.expand_as(rays)).norm(dim=-1)
        torch.testing.assert_close(passes, torch.full_like(passes, 0.11), rtol=0.04, atol=0)


def test_smoothing_drops_outliers_and_keeps_a_ramp() -> None:
    ramp = np.linspace(3, 5, 30)
    np.testing.assert_allclose(smooth(ramp)[3:-3], ramp[3:-3], atol=1e-9)
    spoiled = ramp.copy()
    spoiled[12] = 50
    np.testing.assert_allclose(smooth(spoiled)[3:-3], ramp[3:-3], atol=0.08)
    assert smooth(ramp[:3]).shape == (3,)
    for count in (5, 6, 8):
        assert np.isfinite(smooth(ramp[:count])).all()


def test_faults(tiny_source: Path) -> None:
    video, path = VideoFrames(tiny_source / "video.mp4"), tiny_source / "ball_track.npz"
    np.savez(path, xyr=truth()[:7])
    with pytest.raises(SourceError, match=r"xyr.*\[7, 3\].*\[12, 3\]"):
        load_ball(path, video, Undistortion())
    np.savez(path, xyr=truth() * np.nan)
    with pytest.raises(SourceError, match="ball"):
        load_ball(path, video, Undistortion())
    np.savez(path, other=truth())
    with pytest.raises(SourceError, match="xyr"):
        load_ball(path, video, Undistortion())
