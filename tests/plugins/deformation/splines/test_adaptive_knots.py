"""Keyframes that come and go: where they stand, what they keep, when they change."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from hoigs.core.interfaces.deformation import StepStatistics
from hoigs.core.maths import splines
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.maths.splines import Knots
from hoigs.core.model.entity import Entity
from hoigs.core.model.knot_refit import KnotTrial, deviations_without
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.articulated import Articulated
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.keyframes import AdaptiveKnotsConfig, KnotSchedule
from hoigs.plugins.deformation.rigid_spline import RigidSpline

FRAMES = 33
CAMERA = Camera.look_at(torch.tensor([0.0, 0, -4]), torch.zeros(3), width=64, height=64, fov_y=0.8)
PIXEL = 4 * 2 * math.tan(0.4) / 64  # metres a pixel at the origin

KINDS = {"rigid": RigidSpline, "chs": CubicHermite, "articulated": Articulated}


def schedule(**settings: object) -> KnotSchedule:
    return KnotSchedule([CAMERA] * FRAMES, AdaptiveKnotsConfig(**settings))


def cloud(dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = 0.2 * torch.randn(12, 3, generator=generator, dtype=dtype)
    return Gaussians.from_points(points, scales=0.05)


def adaptive(kind: str, count: int = 9, shake: float = 0.0, **settings: object) -> Entity:
    motion = {k: settings.pop(k) for k in ("tangents",) if k in settings}
    config = KINDS[kind].Config(
        keyframes="adaptive", keyframe_step=1, adaptive=AdaptiveKnotsConfig(**settings), **motion
    )
    model = KINDS[kind](config, num_frames=count, cameras=[CAMERA] * FRAMES)
    entity = Entity(cloud(), model)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in entity.deformation.parameters():
            parameter += shake * torch.randn(parameter.shape, generator=generator)
    return entity


def follow(entity: Entity, path) -> None:
    """Give a rigid spline the translation path(t), knot by knot."""
    model, h = entity.deformation, 1e-4
    times = model.knots.tolist()
    with torch.no_grad():
        places = torch.tensor([path(t) for t in times])
        speeds = torch.tensor([(path(t + h) - path(t - h)) / (2 * h) for t in times])
        model.keyframe_translations[:, 0] = places
        model.translation_tangents[:, 0] = speeds * model.knots.reference


def seen(time: float, error: float, step: int, total: int = 1000) -> StepStatistics:
    found = torch.tensor(error)
    return StepStatistics(Moment(time), CAMERA, found, None, torch.ones(12), step, total)


def test_uniform_knots_are_those_of_the_core():
    generator = torch.Generator().manual_seed(0)
    values, tangents = torch.randn(2, 5, 7, 3, generator=generator)
    still, movable = Knots(7), Knots(7, movable=True)
    for time in (-1.0, 0.0, 0.13, 0.5, 0.99, 1.0, 2.0):
        for derivative in (False, True):
            at = splines.keyframe_position(time, 7)
            expected = splines.cubic_hermite(values, tangents, at, derivative=derivative)
            differences = splines.catmull_rom(values, at, derivative=derivative)
            for knots in (still, movable):
                got = knots.hermite(values, tangents, time, derivative=derivative)
                torch.testing.assert_close(got, expected, atol=1e-5, rtol=1e-4)
                got = knots.catmull_rom(values, time, derivative=derivative)
                torch.testing.assert_close(got, differences, atol=1e-5, rtol=1e-4)
                at_times = knots.at_times([time], values)
                many = splines.cubic_hermite(
                    values[0], tangents[0], at_times, derivative=derivative
                )
                torch.testing.assert_close(many, expected[:1], atol=1e-5, rtol=1e-4)
        expected = splines.linear(values, splines.keyframe_position(time, 7))
        torch.testing.assert_close(movable.linear(values, time), expected, atol=1e-5, rtol=1e-4)
    with pytest.raises(ValueError, match="movable=True"):
        still.place([0.0, 0.3, 1.0])


def test_cubics_are_exact_on_any_knots():
    knots = Knots(5, movable=True)
    knots.place([0.0, 0.07, 0.4, 0.5, 0.93, 1.0])

    def cubic(t: torch.Tensor) -> torch.Tensor:
        return 2 * t**3 - t**2 + 0.3 * t + 1

    samples = torch.linspace(0, 1, 41, dtype=torch.float64)
    values, tangents = knots.fit(
        cubic(samples)[:, None], samples, free_tangents=True, smoothness=1e-8
    )
    t = torch.tensor(knots.tolist(), dtype=torch.float64)
    torch.testing.assert_close(values[:, 0], cubic(t), atol=1e-6, rtol=0)
    torch.testing.assert_close(
        tangents[:, 0], (6 * t**2 - 2 * t + 0.3) * knots.reference, atol=1e-5, rtol=0
    )
    for time in (0.03, 0.2, 0.45, 0.97):
        at = torch.tensor(time, dtype=torch.float64)
        got = knots.hermite(values[None], tangents[None], time)
        assert float(got) == pytest.approx(float(cubic(at)), abs=1e-6)
        speed = knots.hermite(values[None], tangents[None], time, derivative=True)
        assert float(speed) == pytest.approx(float(6 * at**2 - 2 * at + 0.3) / 4, abs=1e-5)
    # finite differences are exact for parabolas, at inner knots
    parabola = (t**2)[None, :, None]
    torch.testing.assert_close(
        knots.differences(parabola)[0, 1:-1, 0], 2 * t[1:-1] * knots.reference
    )
    # and straight lines at all
    line = (3 * t)[None, :, None]
    torch.testing.assert_close(knots.differences(line), torch.full_like(line, 3 * knots.reference))


@pytest.mark.parametrize("kind", KINDS)
def test_inserting_knots_changes_no_place(kind):
    entity = adaptive(kind, shake=0.1)
    model = entity.deformation
    times = [i / 40 for i in range(41)]
    before = [entity(Moment(t)).means for t in times]
    speed = model.velocity(entity.canonical, Moment(0.33)).detach()
    old = {name: model.get_parameter(name).data.clone() for name in model.knot_axes}
    for frame in range(FRAMES):
        model.schedule.observe(seen(frame / 32, 5.0 if 12 <= frame <= 16 else 1.0, 1))
    model.schedule.insert(model, entity.canonical.detach())
    assert len(model.knots) == 11  # a quarter of eight intervals
    assert {0.4375} < set(model.knots.tolist())  # frames 12 to 16 are the interval from 0.375
    for time, place in zip(times, before, strict=True):
        # rotations between cubic knots are read off, and then bend a little differently
        torch.testing.assert_close(entity(Moment(time)).means, place, atol=2e-3, rtol=0)
    torch.testing.assert_close(
        model.velocity(entity.canonical, Moment(0.33)), speed, atol=2e-2, rtol=0
    )
    kept = torch.tensor([t * 8 % 1 == 0 for t in model.knots.tolist()])
    for name, axis in model.knot_axes.items():
        now = model.get_parameter(name).data
        same = now.index_select(axis, kept.nonzero().squeeze(1))
        if "quats" in name:
            same, old[name] = quats_to_matrices(same), quats_to_matrices(old[name])
        torch.testing.assert_close(same, old[name], atol=1e-5, rtol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("tangents", ["learned", "finite-difference"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_knot_that_is_left_out_moves_the_frames_around_it_alone(kind, tangents):
    """Of 17 knots, so that there are others; from a motion before, which all frames are off."""
    entity = adaptive(kind, count=17, shake=0.1, tangents=tangents)
    model, canonical = entity.deformation, entity.canonical.detach()
    screen = model.schedule.screen
    before = screen.paths(model, canonical) + 0.1 * torch.randn(FRAMES, 1, 2)
    whole = []
    for k in range(1, len(model.knots) - 1):
        with KnotTrial(model) as trial:
            trial.leave_out(k)
            whole.append(screen.deviation(before, screen.paths(model, canonical)))
    found = deviations_without(model, canonical, screen, before)
    assert len(found) == 15 and found == pytest.approx(whole, abs=1e-4)


@pytest.mark.parametrize("tangents", ["learned", "finite-difference"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_stands_still_keeps_four_knots(kind, tangents):
    entity = adaptive(kind, tangents=tangents)
    before = entity(Moment(0.4)).means
    entity.deformation.schedule.remove(entity.deformation, entity.canonical.detach())
    assert len(entity.deformation.knots) == 4
    assert entity.deformation.knots.tolist()[0] == 0 and entity.deformation.knots.tolist()[-1] == 1
    torch.testing.assert_close(entity(Moment(0.4)).means, before, atol=1e-5, rtol=0)


def test_knots_stay_where_a_pixel_would_be_missed():
    def jerk(t: float) -> float:  # still, then off by ten pixels in three frames, then still
        return 10 * PIXEL / (1 + math.exp(-(t - 0.6) * 80))

    entity = adaptive("rigid", 17)
    follow(entity, jerk)
    model, canonical = entity.deformation, entity.canonical.detach()
    frames = [f / 32 for f in range(FRAMES)]
    before = model.traced(canonical, frames)
    model.schedule.remove(model, canonical)
    times = model.knots.tolist()
    assert 4 <= len(times) < 14
    off = (model.traced(canonical, frames) - before).norm(dim=-1).mean(1).max() / PIXEL
    assert off < 1.05
    # the knots that are left crowd about the jerk
    narrowest = min(pairwise(times), key=lambda pair: pair[1] - pair[0])
    assert 0.4 < narrowest[0] < 0.8
    loose = adaptive("rigid", 17, pixels=20.0)
    follow(loose, jerk)
    loose.deformation.schedule.remove(loose.deformation, canonical)
    assert len(loose.deformation.knots) == 4


def test_acceleration_finds_the_jerk_too():
    entity = adaptive("rigid", 9, insert_by="acceleration", share=0.05)
    follow(entity, lambda t: 10 * PIXEL / (1 + math.exp(-(t - 0.55) * 60)))
    entity.deformation.schedule.insert(entity.deformation, entity.canonical.detach())
    added = set(entity.deformation.knots.tolist()) - {k / 8 for k in range(9)}
    assert len(added) == 1 and 0.4 < added.pop() < 0.7


def test_rounds_and_their_bounds():
    plan = schedule(begin=0.2, end=0.5, every=100)
    due = {step: plan.due(step, 1000) for step in range(0, 1001, 50)}
    assert {s for s, d in due.items() if d == "both"} == {200, 300, 400}
    assert {s for s, d in due.items() if d == "removal"} == {500}
    entity = adaptive("rigid", 9, maximum=10, share=1.0)
    for frame in range(FRAMES):
        entity.deformation.schedule.observe(seen(frame / 32, 1.0, 1))
    entity.deformation.schedule.insert(entity.deformation, entity.canonical.detach())
    assert len(entity.deformation.knots) == 10
    narrow = adaptive("rigid", 33, share=1.0, spacing=1)  # a knot a frame: nowhere to put one
    for frame in range(FRAMES):
        narrow.deformation.schedule.observe(seen(frame / 32, 1.0, 1))
    narrow.deformation.schedule.insert(narrow.deformation, narrow.canonical.detach())
    assert len(narrow.deformation.knots) == 33
    assert len(adaptive("rigid", 2).deformation.knots) == 4
    with pytest.raises(ValueError, match="clip's cameras"):
        KnotSchedule([])


def test_knots_that_are_not_quite_every_four_frames_may_be_halved():
    for spacing, expected in ((2, 19), (3, 10)):
        entity = adaptive("rigid", 10, share=1.0, spacing=spacing)  # 32 / 9 = 3.56 frames apart
        for frame in range(FRAMES):
            entity.deformation.schedule.observe(seen(frame / 32, 1.0, 1))
        entity.deformation.schedule.insert(entity.deformation, entity.canonical.detach())
        assert len(entity.deformation.knots) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_moments_follow_and_checkpoints_of_other_sizes_restore(kind):
    entity = adaptive(kind, shake=0.1, begin=0.0, every=10)
    model = entity.deformation
    for step in range(1, 10):
        assert model.evolve(entity.canonical.detach(), seen(step / 10, 1.0, step)) == {}
    before = model.knots.tolist()
    changes = model.evolve(entity.canonical.detach(), seen(0.4, 3.0, 10))
    after = model.knots.tolist()
    assert after != before and set(changes) == set(model.knot_axes)
    for name, change in changes.items():
        assert model.get_parameter(name).shape[change.axis] == len(after)
        moments = torch.arange(len(before)).float()
        moments = moments if change.axis == 0 else moments[None]
        moments = moments + torch.zeros([1] * change.axis + [len(before)])
        expected = [before.index(t) if t in before else 0 for t in after]
        assert change.follow(moments).flatten().tolist() == expected
        assert change.fresh.tolist() == [t not in before for t in after]
    assert model.schedule.error_count.sum() == 0  # counted anew after a round
    other = adaptive(kind)
    other.load_state_dict(entity.state_dict())
    assert other.deformation.knots.tolist() == after
    for time in (0.1, 0.62, 1.0):
        torch.testing.assert_close(other(Moment(time)).means, entity(Moment(time)).means)


def test_a_checkpoint_of_another_shape_is_refused():
    state = adaptive("chs").state_dict()
    state["deformation.keyframe_means"] = state["deformation.keyframe_means"][:5]
    with pytest.raises(RuntimeError, match="size mismatch"):
        adaptive("chs").load_state_dict(state)


def test_an_interval_s_error_is_the_mean_of_the_frames_that_were_drawn():
    """Frames of the first interval are drawn often, and those of the last badly."""
    entity = adaptive("rigid", count=5, insert_by="residual", share=0.1)
    model = entity.deformation
    for _ in range(9):
        model.schedule.observe(seen(3 / 32, 1.0, 1))
    for frame in range(FRAMES):
        model.schedule.observe(seen(frame / 32, 2.0 if frame > 24 else 1.0, 1))
    scores = model.schedule._scores(model, entity.canonical, model.knots.tolist())
    assert scores[0] == pytest.approx(1.0) and scores[3] == pytest.approx(17 / 9)
    model.schedule.insert(model, entity.canonical.detach())
    assert model.knots.tolist() == [0, 0.25, 0.5, 0.75, 0.875, 1]


def test_half_of_the_intervals_are_halved_where_half_may():
    entity = adaptive("rigid", count=9, insert_by="residual", share=0.5)
    for frame in range(FRAMES):
        entity.deformation.schedule.observe(seen(frame / 32, 1.0, 1))
    entity.deformation.schedule.insert(entity.deformation, entity.canonical.detach())
    assert len(entity.deformation.knots) == 13


def test_acceleration_is_the_second_difference_in_pixels():
    """A parabola's is the same everywhere, and nothing at the ends of the clip."""
    entity = adaptive("rigid", count=9, insert_by="acceleration")
    follow(entity, lambda t: 0.4 * (t - 0.5) ** 2)
    model, canonical = entity.deformation, entity.canonical.detach()
    scores = model.schedule._scores(model, canonical, model.knots.tolist())
    each = 2 * 0.4 / 32**2 / PIXEL / 8**2  # by the squared length of an interval
    assert scores[3] == pytest.approx(each, rel=0.1)
    assert scores[0] == pytest.approx(0.8 * each, rel=0.1)  # four of its five frames have one


def test_knots_that_move_are_not_held_to_even_accelerations():
    assert "acceleration" not in adaptive("rigid").deformation.regularizers()
