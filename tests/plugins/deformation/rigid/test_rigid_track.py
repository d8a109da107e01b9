"""RigidTrack: poses between frames that need not be evenly spaced."""

from dataclasses import replace

import pytest
import torch

from hoigs.core.maths.rotations import axis_angle_to_quats, quats_to_matrices
from hoigs.core.values.clip import ObjectTrack
from hoigs.plugins.deformation.rigid_track import RigidTrack

TIMES = (0.0, 0.1, 0.35, 0.5, 0.9, 1.0)


def track(times: tuple[float, ...] | None = TIMES, frames: int = 6) -> ObjectTrack:
    """It turns about z by a radian, and moves two metres, a unit of time."""
    at = torch.tensor(TIMES if times is None else times)[:frames]
    turns = torch.nn.functional.pad(at[:, None], (2, 0))
    return ObjectTrack(
        torch.randn(5, 3), torch.rand(5, 3), quats_to_matrices(axis_angle_to_quats(turns)),
        torch.stack((2 * at, 0 * at, 0 * at), -1), torch.ones(frames, dtype=torch.bool),
        times=times,
    )  # fmt: skip


def test_frames_are_met_at_their_own_times() -> None:
    given = track()
    motion = RigidTrack(given)
    for i, time in enumerate(TIMES):
        quat, place = motion.at(time)
        torch.testing.assert_close(place, given.translations[i], atol=1e-5, rtol=0)
        turned = quats_to_matrices(quat)
        torch.testing.assert_close(turned, given.rotations[i], atol=1e-5, rtol=0)
    # within a frame interval rotations are even
    quat, _ = motion.at(0.7)
    torch.testing.assert_close(
        quats_to_matrices(quat), quats_to_matrices(axis_angle_to_quats(torch.tensor([0, 0, 0.7]))),
        atol=1e-5, rtol=0,
    )  # fmt: skip
    # without times the same frames are evenly spaced
    torch.testing.assert_close(
        RigidTrack(replace(given, times=None)).at(0.2)[1], given.translations[1]
    )


@pytest.mark.parametrize("time", [0.03, 0.2, 0.7, 0.95])
def test_velocity_is_the_derivative_where_frames_are_uneven(time: float) -> None:
    motion, points, step = RigidTrack(track()).double(), torch.randn(4, 3).double(), 1e-4
    after, before = motion.carry(points, time + step), motion.carry(points, time - step)
    own = torch.zeros_like(points)
    for at in (time, torch.tensor(time, dtype=torch.float64)):
        found = motion.velocity(points, at, own, unit=0.25)
        torch.testing.assert_close(found, 0.25 * (after - before) / (2 * step), atol=2e-3, rtol=0)


@pytest.mark.parametrize("uneven", [True, False])
def test_paths_are_carried_as_each_time_alone(uneven: bool) -> None:
    given = track() if uneven else replace(track(), times=None)
    motion, times = RigidTrack(given), [0.0, 0.13, 0.2, 0.5, 0.99, 1.0]
    paths = torch.randn(len(times), 5, 3)
    alone = [motion.carry(points, time) for points, time in zip(paths, times, strict=True)]
    torch.testing.assert_close(motion.carry_paths(paths, times), torch.stack(alone))


def test_a_single_frame_stands_still() -> None:
    given = track((0.0,), frames=1)
    motion, points = RigidTrack(given), torch.randn(3, 3)
    for time in (0.0, 0.4, 1.0):
        where = points @ given.rotations[0].T + given.translations[0]
        torch.testing.assert_close(motion.carry(points, time), where)
        torch.testing.assert_close(motion.carry_paths(points[None], [time])[0], where)
    own = torch.randn(3, 3)
    moving = motion.velocity(points, 0.4, own, unit=0.1)
    torch.testing.assert_close(moving, own @ given.rotations[0].T)
    assert motion.largest_step(5) == 0


def test_frames_that_were_not_seen_weigh_a_tenth() -> None:
    still = torch.eye(3).expand(41, 3, 3)
    heights = torch.zeros(41, 3)
    heights[20, 1] = 1.0  # an outlier
    given = ObjectTrack(
        torch.zeros(1, 3), torch.zeros(1, 3), still, heights, torch.ones(41, dtype=torch.bool)
    )
    unseen = torch.arange(41) != 20
    origin = torch.zeros(1, 3)
    seen, hidden = (
        float(RigidTrack(t).knots(origin, 2, free_tangents=True)[0].abs().max())
        for t in (given, replace(given, observed=unseen))
    )
    assert hidden == pytest.approx(0.1 * seen, rel=0.1)


def test_the_largest_step_between_keyframes() -> None:
    assert RigidTrack(track()).largest_step(3) == pytest.approx(0.5, abs=1e-3)
    assert RigidTrack(track()).largest_step(5) == pytest.approx(0.25, abs=1e-3)


def test_two_frames_are_met_at_their_own_times() -> None:
    motion = RigidTrack(track((0.0, 0.5), frames=2))
    assert float(motion.at(0.25)[1][0]) == pytest.approx(0.5)  # of evenly spaced ones: 0.25


def test_rounding_above_one_is_no_turn() -> None:
    turned = quats_to_matrices(axis_angle_to_quats(torch.tensor([0.3, 0.5, 0.7])))
    motion = RigidTrack(replace(track(), rotations=turned.expand(6, 3, 3)))
    motion.quats *= 1 + 1e-6
    assert motion.largest_step(5) == pytest.approx(0, abs=1e-2)
