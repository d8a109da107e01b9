"""deformation:rigid-spline: one SE(3) spline an object."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotation_splines import hermite_quats
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    axis_angle_to_quats,
    multiply_quats,
    quats_to_matrices,
    turn_between,
)
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.rigid_spline import RigidSpline, RigidSplineConfig, TrackGuide
from hoigs.plugins.features.spline_motion import SplineMotionFeatures

KINDS = [
    {"tangents": tangents, "rotation": rotation}
    for tangents in ("learned", "finite-difference")
    for rotation in ("cubic", "slerp")
]


def cloud(count: int = 9, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = 0.2 * torch.randn(count, 3, generator=generator, dtype=dtype)
    return Gaussians.from_points(points, torch.rand(count, 3, generator=generator), scales=0.05)


def track_of(rotations: torch.Tensor, translations: torch.Tensor) -> ObjectTrack:
    points = cloud().means
    return ObjectTrack(
        points, torch.rand(len(points), 3), rotations, translations,
        torch.ones(len(rotations), dtype=torch.bool),
    )  # fmt: skip


def steady_track(frames: int = 17, turn: float = 2.0) -> ObjectTrack:
    """Constant linear and angular velocity."""
    s = torch.linspace(0, 1, frames)[:, None]
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -1.0]), dim=0)
    velocity, start = torch.tensor([1.0, -0.5, 0.25]), torch.tensor([0.1, 0.2, 3.0])
    return track_of(axis_angle_to_matrices(turn * s * axis), start + s * velocity)


def rigid(
    keyframes: int | None = None,
    *,
    track: ObjectTrack | None = None,
    num_frames: int | None = None,
    **settings: object,
) -> RigidSpline:
    config = RigidSplineConfig(keyframes=keyframes, **settings)
    return RigidSpline(config, track=track, num_frames=num_frames)


def perturbed(model: RigidSpline, seed: int = 0, size: float = 0.2) -> RigidSpline:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator).to(parameter)
    return model


def on_track(track: ObjectTrack, **settings: object) -> Entity:
    return Entity(Gaussians.from_points(track.points), rigid(track=track, **settings))


def worst(entity: Entity, track: ObjectTrack) -> float:
    """Largest distance from where the track carries the points, metres."""
    last = len(track.rotations) - 1
    return max(
        float(
            (
                entity(Moment(f / last)).means
                - (entity.means @ track.rotations[f].mT + track.translations[f])
            )
            .norm(dim=-1)
            .max()
            .detach()
        )
        for f in range(last + 1)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_steady_motion_is_exact(kind):
    track = steady_track()
    entity = on_track(track, **kind)
    assert entity.deformation.keyframes == 5
    # the start fits rotation matrices, entry by entry, where tangents are free: 0.1 mm off
    fitted = kind == KINDS[0]
    assert worst(entity, track) < (3e-4 if fitted else 1e-5)
    velocity = entity.deformation.velocity(entity.canonical, Moment(0.3))
    spoke = entity(Moment(0.3)).means - (torch.tensor([0.1, 0.2, 3.0]) + 0.3 * LINE)
    spin = 2.0 * torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -1.0]), dim=0)
    expected = (LINE + torch.linalg.cross(spin.expand_as(spoke), spoke)) / 4  # 4 intervals
    torch.testing.assert_close(velocity, expected, atol=2e-3 if fitted else 1e-5, rtol=1e-4)


LINE = torch.tensor([1.0, -0.5, 0.25])


@pytest.mark.parametrize("kind", KINDS)
def test_passes_through_its_keyframes(kind):
    entity = Entity(cloud(), rigid(5, **kind))
    model = perturbed(entity.deformation)
    center = entity.means.mean(0)
    for k in range(5):
        turn = quats_to_matrices(model.keyframe_quats[k])
        expected = (entity.means - center) @ turn.mT + center + model.keyframe_translations[k]
        out = entity(Moment(k / 4))
        torch.testing.assert_close(out.means, expected, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(
            quats_to_matrices(out.quats), turn.expand(9, 3, 3), atol=1e-6, rtol=0
        )


@pytest.mark.parametrize("kind", KINDS)
def test_starts_at_rest_and_is_held_outside_the_clip(kind):
    canonical = cloud()
    entity = Entity(canonical, rigid(num_frames=30, **kind))
    assert entity.deformation.keyframes == 8 and entity.deformation.input_space == "world"
    for time in (0.0, 0.37, 1.0):
        torch.testing.assert_close(entity(Moment(time)).means, canonical.means, atol=1e-6, rtol=0)
    perturbed(entity.deformation)
    for outside, end in ((1.5, 1.0), (-0.5, 0.0)):
        torch.testing.assert_close(entity(Moment(outside)).means, entity(Moment(end)).means)
    # the last frame is the last keyframe, for any count
    for frames in (1, 2, 3, 5, 300):
        entity = Entity(canonical, rigid(num_frames=frames, **kind))
        last = perturbed(entity.deformation).keyframe_translations[-1]
        moved = entity(Moment(1.0)).means.mean(0) - canonical.means.mean(0)
        torch.testing.assert_close(moved, last, atol=1e-6, rtol=1e-5)


def require_derivative(entity: Entity, intervals: int) -> None:
    """Its velocity, per one of so many intervals, is the numeric derivative of its means."""
    model, h = perturbed(entity.deformation), 1e-6
    for time in (0.07, 0.45, 0.99):
        ahead, behind = (entity(Moment(time + step)).means for step in (h, -h))
        exact = model.velocity(entity.canonical, Moment(time))
        numeric = (ahead - behind) / (2 * h * intervals)
        torch.testing.assert_close(exact, numeric, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_is_the_derivative(kind):
    require_derivative(Entity(cloud(dtype=torch.float64), rigid(6, **kind)), intervals=5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_turn_through_the_seam_does_not_flip(kind):  # F4
    track = steady_track(frames=41, turn=math.radians(350))
    entity = on_track(track, **kind)
    model = entity.deformation
    assert worst(entity, track) < 5e-4
    before = [entity(Moment(i / 97)).means for i in range(98)]
    turns = [model.pose(i / 97)[0] for i in range(98)]
    speed = torch.stack([turn_between(a, b).norm() for a, b in pairwise(turns)]).detach()
    assert speed.max() < 1.05 * speed.min()  # a flip would be a jump, or a stop
    with torch.no_grad():
        model.keyframe_quats[::2] *= -1
    for i, old in enumerate(before):
        torch.testing.assert_close(entity(Moment(i / 97)).means, old, atol=1e-5, rtol=0)


def test_the_cubic_rotation_has_its_end_velocities_and_no_kink():
    generator = torch.Generator().manual_seed(4)
    a, b = torch.randn(2, 4, generator=generator, dtype=torch.float64)
    a, b = a / a.norm(), b / b.norm()
    va, vb = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    for r, quat, velocity in ((0.0, a, va), (1.0, b, vb)):
        q, speed = hermite_quats(a, b, va, vb, r, 0.7)
        torch.testing.assert_close(quats_to_matrices(q), quats_to_matrices(quat))
        torch.testing.assert_close(speed, velocity)
    # constant turning: exact at every r
    axis = torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64)
    q, speed = hermite_quats(a, multiply_quats(a, axis_angle_to_quats(axis)), axis, axis, 0.3)
    expected = multiply_quats(a, axis_angle_to_quats(0.3 * axis))
    torch.testing.assert_close(quats_to_matrices(q), quats_to_matrices(expected))
    torch.testing.assert_close(speed, axis)


@pytest.mark.parametrize("kind", KINDS)
def test_gradcheck_and_every_parameter_learns(kind):
    canonical = cloud(3, torch.float64)
    model = rigid(4, **kind)
    model.bind(canonical)
    perturbed(model)
    names = [n for n, _ in model.named_parameters()]

    def run(*parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        values = dict(zip(names, parameters, strict=True))
        outs = [
            torch.func.functional_call(model, values, (canonical, Moment(t))) for t in (0.2, 0.9)
        ]
        return tuple(x for out in outs for x in (out.means, out.quats))

    assert torch.autograd.gradcheck(run, tuple(model.parameters()))
    weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    total = sum((model(canonical, Moment(t)).means * weights).sum() for t in (0.1, 0.5, 0.9))
    total.backward()
    for name, parameter in model.named_parameters():
        assert (parameter.grad.abs().sum(-1) > 0).all(), name


def test_finite_gradients_at_rest_and_at_half_turns():  # F5
    for second in ([1.0, 0, 0, 0], [0, 1.0, 0, 0], [-1.0, 0, 0, 0]):
        for kind in KINDS:
            entity = Entity(cloud(2), rigid(2, **kind))
            model = entity.deformation
            model.keyframe_quats.data = torch.tensor([[1.0, 0, 0, 0], second])
            out = entity(Moment(0.5))
            (out.quats.sum() + out.means.sum()).backward()
            assert torch.isfinite(out.quats).all()
            assert torch.isfinite(model.keyframe_quats.grad).all()


def test_residual_features_and_topology():
    track = steady_track()
    model = RigidSpline.from_config(RigidSplineConfig(), BuildContext(object_track=track))
    entity = Entity(
        Gaussians.from_points(track.points),
        model,
        SplineMotionFeatures(SplineMotionFeatures.Config(embedding="shared")),
    )
    assert entity.tokens(Moment(0.4)).features.shape == (9, 32)
    shift = torch.randn(9, 3)
    moved = entity(Moment(0.2), Residual(means=shift)).means
    torch.testing.assert_close(moved, entity(Moment(0.2)).means + shift)
    assert entity.means.requires_grad  # the object's own shape is trained
    change = TopologyChange.keep(torch.arange(9) % 2 == 0)
    entity.apply_topology(change, entity.canonical.detach()[change.source])
    assert len(entity) == 5 and worst(entity, track) < 3e-4


def test_state_dict_round_trip():
    for kind in KINDS:
        source = Entity(cloud(), rigid(5, **kind))
        perturbed(source.deformation)
        target = Entity(cloud(4), rigid(5, **kind))
        target.resize(9)
        target.load_state_dict(source.state_dict())
        torch.testing.assert_close(source(Moment(0.3)).means, target(Moment(0.3)).means)
    with pytest.raises(RuntimeError, match="size mismatch"):
        Entity(cloud(), rigid(5)).load_state_dict(
            {**source.state_dict(), "deformation.keyframe_quats": torch.zeros(5, 3)}, strict=False
        )


def test_tangents_are_penalised_against_finite_differences():
    model = rigid(3)
    model.bind(cloud(1))
    model.keyframe_translations.data = torch.tensor([[0.0, 0, 0], [1, 0, 0], [4, 0, 0]])
    model.translation_tangents.data = torch.tensor([[1.0, 0, 0], [2, 3, 0], [3, 0, 0]])
    penalties = model.regularizers()
    assert penalties["acceleration"].item() == pytest.approx(4.0)
    assert penalties["tangent"].item() == pytest.approx(3.0)


def test_the_track_is_a_penalty_in_square_metres():
    track = steady_track()
    model = on_track(track).deformation
    assert model.regularizers()["track"].item() < 1e-6  # a steady motion is a spline
    with torch.no_grad():
        model.keyframe_translations += torch.tensor([0.0, 0.3, 0.4])
    assert model.regularizers()["track"].item() == pytest.approx(0.25, rel=1e-3)
    assert "track" in model.regularizer_weights
    free = rigid(3)
    free.bind(cloud())
    assert "track" not in free.regularizers()


@pytest.mark.parametrize(("seen", "penalty"), [(True, 1 / 17), (False, 0.1 / 16.1)])
def test_frames_that_nobody_saw_hold_the_splines_less(seen, penalty):
    track = steady_track()
    model = on_track(track).deformation
    wrong = replace(track, translations=track.translations.clone(), observed=track.observed.clone())
    wrong.translations[8, 2] += 1
    wrong.observed[8] = seen
    model.guide = TrackGuide(wrong)
    assert model.regularizers()["track"].item() == pytest.approx(penalty, rel=1e-3)


def jagged_track(frames: int = 9) -> ObjectTrack:
    generator = torch.Generator().manual_seed(3)
    turns = 0.4 * torch.randn(frames, 3, generator=generator)
    return track_of(
        axis_angle_to_matrices(turns), 0.3 * torch.randn(frames, 3, generator=generator)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_about_its_track_it_follows_every_frame_and_corrects_them(kind):
    track = jagged_track()
    assert worst(on_track(track, keyframes=3, **kind), track) > 0.05  # three knots are too few
    entity = on_track(track, keyframes=3, about_track=True, **kind)
    assert worst(entity, track) < 1e-5
    model = entity.deformation
    assert "track" not in model.regularizers() and set(model.rates.values()) == {"pose"}
    with torch.no_grad():
        model.keyframe_translations += torch.tensor([0.0, 0.0, 0.1])  # in the object's frame
    expected = (entity.means + torch.tensor([0.0, 0.0, 0.1])) @ track.rotations[4].mT
    torch.testing.assert_close(entity(Moment(0.5)).means, expected + track.translations[4])


@pytest.mark.parametrize("kind", KINDS)
def test_about_its_track_its_velocity_and_its_paths_are_exact(kind):
    entity = on_track(jagged_track(), keyframes=4, about_track=True, **kind).double()
    require_derivative(entity, intervals=3)
    path = entity.deformation.traced(entity.canonical, [0.3])[0]
    torch.testing.assert_close(path, entity(Moment(0.3)).means)


def test_refuses_what_it_cannot_derive():
    with pytest.raises(ValueError, match="RigidSpline needs `keyframes`"):
        RigidSpline()
    with pytest.raises(ValueError, match="needs `keyframes`"):
        RigidSpline.from_config(RigidSplineConfig(keyframes="adaptive"), BuildContext())
    with pytest.warns(UserWarning, match="turns 166 degrees"):
        on_track(steady_track(frames=5, turn=2.9), keyframes=2)
