"""deformation:tracked-chs: splines in the object's frame, about every frame of its track."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.tracked_chs import (
    TrackedHermite,
    TrackedHermiteConfig,
    nonrigid_part,
)

FRAMES = 17


def jittering_track(count: int = 10, dtype: torch.dtype = torch.float64) -> ObjectTrack:
    """Poses that no spline of a knot every four frames follows."""
    generator = torch.Generator().manual_seed(4)

    def noise() -> torch.Tensor:
        return torch.randn(FRAMES, 3, generator=generator, dtype=dtype)

    return ObjectTrack(
        points=torch.randn(count, 3, generator=generator, dtype=dtype),
        colors=torch.rand(count, 3, generator=generator, dtype=dtype),
        rotations=axis_angle_to_matrices(0.3 * noise()),
        translations=noise(),
        observed=torch.ones(FRAMES, dtype=torch.bool),
    )


def entity_of(track: ObjectTrack, *, perturb: float = 0.0, **settings) -> Entity:
    canonical = Gaussians.from_points(track.points, scales=0.05)
    model = TrackedHermite(TrackedHermiteConfig(**settings), track=track)
    entity = Entity(canonical, model)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter += perturb * noise.to(parameter)
    return entity


def test_starts_on_every_frame_of_the_track_where_chs_cannot():
    track = jittering_track()
    entity = entity_of(track)
    chs = Entity(Gaussians.from_points(track.points, scales=0.05), CubicHermite(track=track))
    missed = []
    for frame in range(FRAMES):
        moment = Moment(frame / (FRAMES - 1))
        told = track.points @ track.rotations[frame].mT + track.translations[frame]
        out = entity(moment)
        torch.testing.assert_close(out.means, told)
        torch.testing.assert_close(entity.deformation.means_at(entity.canonical, moment), told)
        torch.testing.assert_close(
            quats_to_matrices(out.quats), track.rotations[frame].expand(10, 3, 3)
        )
        missed.append((chs(moment).means - told).norm(dim=-1).mean().item())
    assert max(missed) > 0.1


def test_without_a_track_it_is_chs_about_rest():
    canonical = Gaussians.from_points(torch.randn(6, 3), scales=0.05)
    about, chs = (
        Entity(canonical, kind(kind.Config(keyframes=4))) for kind in (TrackedHermite, CubicHermite)
    )
    assert about.deformation.input_space == chs.deformation.input_space == "world"
    assert about.means.requires_grad and not chs.means.requires_grad
    # a whole motion, not what is left of it
    assert about.deformation.rates == chs.deformation.rates
    assert TrackedHermite(track=jittering_track()).rates["keyframe_means"] == "pose"
    with torch.no_grad():
        departs = 0.3 * torch.randn(6, 4, 3)
        about.deformation.keyframe_means.copy_(departs)
        chs.deformation.keyframe_means.copy_(canonical.means[:, None] + departs)
        about.deformation.opacity_logits.copy_(departs[..., 0])
        chs.deformation.opacity_logits.copy_(canonical.opacity_logits[:, None] + departs[..., 0])
    moment = Moment(0.4)
    for field in ("means", "opacity_logits"):
        torch.testing.assert_close(getattr(about(moment), field), getattr(chs(moment), field))
    velocities = [e.deformation.velocity(e.canonical, moment) for e in (about, chs)]
    torch.testing.assert_close(*velocities)
    peaks = [e.deformation.peak_opacity_logits(e.canonical) for e in (about, chs)]
    torch.testing.assert_close(*peaks)


def test_velocity_is_the_derivative_in_the_world():
    entity = entity_of(jittering_track(), perturb=0.3)
    intervals = entity.deformation.keyframes - 1
    h = 1e-6
    for time in (0.1, 0.4, 0.72):  # between frames: slerp's speed jumps at them
        ahead, behind = (entity(Moment(time + s)).means for s in (h, -h))
        numeric = (ahead - behind) / (2 * h * intervals)
        exact = entity.deformation.velocity(entity.canonical, Moment(time))
        torch.testing.assert_close(exact, numeric, atol=1e-6, rtol=1e-5)


def test_a_tensor_as_time_says_the_same_for_recordings():
    entity = entity_of(jittering_track(), perturb=0.3)
    for time in (0.0, 0.33, 1.0):
        asked = Moment(torch.tensor(time, dtype=torch.float64))
        for field in ("means", "quats"):
            said = [getattr(entity(moment), field) for moment in (Moment(time), asked)]
            torch.testing.assert_close(*said)


def test_traces_what_it_draws():
    entity = entity_of(jittering_track(), perturb=0.3)
    paths = entity.deformation.traced(entity.canonical, [0.2, 0.9])
    for path, time in zip(paths, (0.2, 0.9), strict=True):
        torch.testing.assert_close(path, entity(Moment(time)).means)


def test_the_shape_is_learned_from_all_frames():
    entity = entity_of(jittering_track())
    for time in (0.1, 0.9):
        entity.means.grad = None
        entity(Moment(time)).means.square().sum().backward()
        assert (entity.means.grad.abs().sum(-1) > 0).all()


def test_departures_from_a_rigid_motion_are_penalised():
    entity = entity_of(jittering_track())
    knots, shape = entity.deformation.keyframe_means, entity.canonical.means
    assert "departure" not in entity.regularizers()  # nothing is drawn yet
    entity(Moment(0.3))
    error = torch.tensor([0.01, -0.02, 0.03], dtype=shape.dtype)  # a turn of the track, radians
    with torch.no_grad():
        knots += torch.linalg.cross(error.expand_as(shape), shape)[:, None] + 5 * error
    assert entity.regularizers()["departure"] < 1e-12
    with torch.no_grad():
        knots[0, 2] += 0.1
    penalty = entity.regularizers()["departure"]
    assert 0.3 * 0.03 / knots[..., 0].numel() < penalty < 0.03 / knots[..., 0].numel()
    free = Entity(entity.canonical.detach(), TrackedHermite(num_frames=17))
    free(Moment(0.3))
    assert "departure" not in free.regularizers()  # all of the motion is the splines' own


@pytest.mark.parametrize("axes", [3, 1])
def test_a_rigid_part_is_the_nearest(axes):
    """Also of points on one line, about which no turn shows."""
    points = torch.randn(30, 3, dtype=torch.float64)
    points[:, axes:] = 0
    offsets = torch.randn(30, 4, 3, dtype=torch.float64, requires_grad=True)
    left = nonrigid_part(offsets, points)
    turns = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    arms = points - points.mean(0)
    moved = left.detach() + torch.linalg.cross(
        turns.expand(30, 4, 3), arms[:, None].expand(30, 4, 3)
    )
    (slope,) = torch.autograd.grad(moved.square().sum(), turns)
    assert slope.abs().max() < 1e-4 * offsets.square().sum()
    assert left.square().sum() < offsets.square().sum()
    torch.testing.assert_close(left.mean(0), torch.zeros(4, 3, dtype=torch.float64))


def test_children_stay_beside_their_parents():
    track = jittering_track()
    entity = entity_of(track)
    change = TopologyChange(
        source=torch.tensor([3, 3]),
        fresh=torch.tensor([False, True]),
        offsets=torch.tensor([[0.0, 0, 0], [0.1, 0.02, -0.05]], dtype=torch.float64),
    )
    parent = entity.canonical.detach()[change.source]
    canonical = parent.replace(means=parent.means + change.offsets)
    entity.apply_topology(change, canonical)
    for frame in (0, 5, 16):
        told = canonical.means @ track.rotations[frame].mT + track.translations[frame]
        torch.testing.assert_close(entity(Moment(frame / (FRAMES - 1))).means, told)


@pytest.mark.parametrize("tangents", ["learned", "finite-difference"])
def test_gradients(tangents):
    track = jittering_track(count=2)
    canonical = Gaussians.from_points(track.points, scales=0.05)
    model = entity_of(track, perturb=0.3, tangents=tangents).deformation
    names = [name for name, _ in model.named_parameters()]

    def run(*parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        values = dict(zip(names, parameters, strict=True))
        out = torch.func.functional_call(model, values, (canonical, Moment(0.55)))
        return out.means, out.quats, out.opacity_logits

    assert torch.autograd.gradcheck(run, tuple(model.parameters()))


def test_from_a_spec():
    track = jittering_track()
    context = BuildContext(object_track=track)
    model = TrackedHermite.from_config(TrackedHermiteConfig(), context)
    assert model.input_space == "canonical" and model.keyframes == 5
    model = TrackedHermite.from_config(TrackedHermiteConfig(track=False, keyframes=3), context)
    assert model.input_space == "world" and model.carrier is None


def test_opacities_are_keyed_where_nothing_says_how_the_object_turns():
    track = jittering_track()
    assert not entity_of(track, opacity="auto").deformation.keyed
    outline = replace(track, rotation_known=False)
    assert entity_of(outline, opacity="auto").deformation.keyed
    assert not entity_of(outline, opacity="constant").deformation.keyed


@pytest.mark.parametrize(("unseen", "keyed"), [((0, 4), True), ((0, 3), False), ((5, 12), False)])
def test_opacities_are_keyed_where_the_object_comes_or_goes(unseen, keyed):
    """Not where it is hidden for a while: what is hidden is still there."""
    track = jittering_track()
    for flipped in (False, True):
        observed = torch.ones_like(track.observed)
        observed[slice(*unseen)] = False
        observed = observed.flip(0) if flipped else observed
        entity = entity_of(replace(track, observed=observed), opacity="auto")
        assert entity.deformation.keyed == keyed
