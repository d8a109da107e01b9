"""deformation:rigid-residual and deformation:articulated: motions beyond one rigid one."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.articulated import Articulated, ArticulatedConfig
from hoigs.plugins.deformation.rigid_residual import RigidResidual, RigidResidualConfig
from hoigs.plugins.deformation.rigid_spline import RigidSpline


def articulated(
    keyframes: int | None = 5,
    *,
    track: ObjectTrack | None = None,
    moving: torch.Tensor | None = None,
    **settings: object,
) -> Articulated:
    return Articulated(
        ArticulatedConfig(keyframes=keyframes, **settings), track=track, moving=moving
    )


MAKERS = {
    "residual": lambda **given: RigidResidual(
        RigidResidualConfig(keyframes=5, residual_step=4), **{"num_frames": 9, **given}
    ),
    "revolute": articulated,
    "prismatic": lambda **given: articulated(joint="prismatic", **given),
    "revolute-fd": lambda **given: articulated(tangents="finite-difference", **given),
}


def cloud(count: int = 12, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(count, 3, generator=generator, dtype=dtype)
    points = points * torch.tensor([0.3, 0.1, 0.05], dtype=dtype)
    return Gaussians.from_points(points, torch.rand(count, 3, generator=generator), scales=0.05)


def track(frames: int = 17, moving: torch.Tensor | None = None) -> ObjectTrack:
    s = torch.linspace(0, 1, frames)[:, None]
    points = cloud().means
    return ObjectTrack(
        points,
        torch.rand(len(points), 3),
        axis_angle_to_matrices(s * torch.tensor([0.2, 0.9, -0.4])),
        torch.tensor([0.1, 0.2, 3.0]) + s * torch.tensor([1.0, 0.5, 0.0]),
        torch.ones(frames, dtype=torch.bool),
        moving=moving,
    )


def shaken(entity: Entity, size: float = 0.2) -> Entity:
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for parameter in entity.deformation.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator).to(parameter)
    return entity


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_starts_as_the_rigid_spline(make):
    rigid = Entity(cloud(), RigidSpline(RigidSpline.Config(keyframes=5), track=track()))
    entity = Entity(cloud(), make(track=track()))
    for time in (0.0, 0.3, 1.0):
        torch.testing.assert_close(
            entity(Moment(time)).means, rigid(Moment(time)).means, atol=2e-4, rtol=0
        )


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_velocity_is_the_derivative_and_every_parameter_learns(make):
    entity = shaken(Entity(cloud(dtype=torch.float64), make()))
    model = entity.deformation
    h = 1e-6
    for time in (0.07, 0.4, 0.93):
        numeric = (entity(Moment(time + h)).means - entity(Moment(time - h)).means) / (2 * h * 4)
        exact = model.velocity(entity.canonical, Moment(time))
        torch.testing.assert_close(exact, numeric, atol=1e-7, rtol=1e-6)
    weights = torch.randn(12, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    total = torch.zeros((), dtype=torch.float64)
    for time in (0.05, 0.3, 0.6, 0.9):
        out = entity(Moment(time))
        total = total + (torch.cat((out.means, out.quats), 1) * weights * (1 + time)).sum()
    total.backward()
    for name, parameter in model.named_parameters():
        if name == "pivot" and model.config.joint == "prismatic":
            continue  # a slide has no pivot
        assert torch.isfinite(parameter.grad).all(), name
        rows = parameter.grad.flatten(1) if parameter.dim() > 1 else parameter.grad[:, None]
        assert (rows.abs().sum(1) > 0).all(), name
    assert torch.equal(entity(Moment(2.0)).means, entity(Moment(1.0)).means)


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_gradcheck(make):
    canonical = cloud(3, torch.float64)
    model = make()
    model.bind(canonical)
    with torch.no_grad():
        for i, parameter in enumerate(model.parameters()):
            generator = torch.Generator().manual_seed(i)
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator).to(parameter)
    names = [n for n, _ in model.named_parameters()]

    def run(*parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        values = dict(zip(names, parameters, strict=True))
        out = torch.func.functional_call(model, values, (canonical, Moment(0.55)))
        return out.means, out.quats

    assert torch.autograd.gradcheck(run, tuple(model.parameters()), fast_mode=True)


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_rows_follow_and_checkpoints_restore(make):
    entity = shaken(Entity(cloud(), make()))
    source = torch.tensor([2, 2, 9, 0])
    name = "offsets" if hasattr(entity.deformation, "offsets") else "part_logits"
    before = entity.deformation.get_parameter(name).detach().clone()
    change = TopologyChange(source, torch.zeros(4, dtype=torch.bool), torch.zeros(4, 3))
    places = entity(Moment(0.4)).means[source]
    entity.apply_topology(change, entity.canonical.detach()[source])
    assert torch.equal(entity.deformation.get_parameter(name), before[source])
    torch.testing.assert_close(entity(Moment(0.4)).means, places)
    other = Entity(cloud(7), make())
    other.resize(4)
    other.load_state_dict(entity.state_dict())
    torch.testing.assert_close(other(Moment(0.4)).means, entity(Moment(0.4)).means)


def test_offsets_move_in_the_objects_frame_and_are_penalised():
    model = RigidResidual.from_config(
        RigidResidualConfig(residual_step=4), BuildContext(object_track=track())
    )
    entity = Entity(cloud(), model)
    assert model.offsets.shape == (12, 5, 3)
    before = entity(Moment(0.5))
    with torch.no_grad():
        model.offsets[:] = torch.tensor([0.0, 0.1, 0.0])
    moved = entity(Moment(0.5)).means - before.means
    turn = quats_to_matrices(model.pose(0.5)[0])
    torch.testing.assert_close(moved, turn[:, 1].expand(12, 3) * 0.1, atol=1e-6, rtol=1e-4)
    assert model.regularizers()["residual"].item() == pytest.approx(0.01)


def test_a_hinge_turns_the_labelled_part_about_its_axis():
    moving = cloud().means[:, 0] > 0
    model = Articulated.from_config(
        ArticulatedConfig(axis=(0, 0, -1), pivot=(0, 0, 0)),
        BuildContext(object_track=track(moving=moving)),
    )
    entity = Entity(cloud(), model)
    weights = torch.sigmoid(model.part_logits)
    assert (weights[moving] > 0.9).all() and (weights[~moving] < 0.1).all()
    with torch.no_grad():
        model.part_logits *= 20  # certain
        model.joint_values[:, 0] = torch.linspace(0, math.pi / 2, 5)
        model.joint_tangents[:, 0] = math.pi / 8
    # ARCTIC: the top is turned about the canonical axis (0, 0, -1), then the object's pose
    for time in (0.0, 0.4, 1.0):
        quat, place, _, _ = model.pose(time)
        turn = axis_angle_to_matrices(torch.tensor([0.0, 0, -1]) * time * math.pi / 2)
        shape = torch.where(moving[:, None], entity.means @ turn.mT, entity.means)
        expected = shape @ quats_to_matrices(quat).mT + place
        torch.testing.assert_close(entity(Moment(time)).means, expected, atol=1e-5, rtol=0)


def test_a_slide_moves_along_its_axis_and_parts_are_guessed_from_the_shape():
    entity = Entity(cloud(), articulated(3, joint="prismatic", axis=(0, 2, 0)))
    model = entity.deformation
    weights = torch.sigmoid(model.part_logits).detach()
    # along the longest axis, from one end to the other
    pair = torch.stack((weights.detach(), entity.means.detach()[:, 0]))
    assert abs(float(torch.corrcoef(pair)[0, 1])) > 0.95
    assert 0.15 < weights.min() < 0.5 < weights.max() < 0.85
    with torch.no_grad():
        model.joint_values.fill_(0.2)
    moved = entity(Moment(0.3)).means - entity.means
    torch.testing.assert_close(moved, weights[:, None] * torch.tensor([0.0, 0.2, 0.0]))
    expected = (weights * (1 - weights)).mean()
    torch.testing.assert_close(model.regularizers()["parts"], expected)


def test_a_hinge_is_found_from_where_the_points_go():
    """Known poses and labels; axis, pivot and angle are learned from point positions."""
    moving = cloud(40).means[:, 0] > 0.05
    canonical = cloud(40)
    axis = torch.nn.functional.normalize(torch.tensor([0.1, 0.9, 0.3]), dim=0)
    pivot = torch.tensor([0.05, 0.02, 0.0])

    def truth(time: float) -> torch.Tensor:
        turn = axis_angle_to_matrices(axis * 1.2 * math.sin(math.pi * time))
        return torch.where(
            moving[:, None], (canonical.means - pivot) @ turn.mT + pivot, canonical.means
        )

    given = ObjectTrack(
        canonical.means, canonical.colors, torch.eye(3).repeat(9, 1, 1), torch.zeros(9, 3),
        torch.ones(9, dtype=torch.bool), moving=moving,
    )  # fmt: skip
    entity = Entity(canonical, articulated(track=given, moving=moving, axis=(0, 1, 0)))
    named = dict(entity.deformation.named_parameters())
    logits = named.pop("part_logits")
    optimizer = torch.optim.Adam(
        [{"params": list(named.values()), "lr": 0.03}, {"params": [logits], "lr": 0.3}]
    )
    times = [i / 8 for i in range(9)]
    for step in range(150):
        loss = sum((entity(Moment(t)).means - truth(t)).square().sum() for t in times)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        optimizer.param_groups[0]["lr"] = 0.03 * (1 - step / 150)
    worst = max(
        float((entity(Moment(t)).means - truth(t)).detach().norm(dim=-1).max()) for t in times
    )
    assert worst < 0.08  # metres, of 1.07 at the start
    found = torch.nn.functional.normalize(entity.deformation.axis.detach(), dim=0)
    assert abs(float(found @ axis)) > math.cos(math.radians(5))


def test_refuses_labels_that_do_not_fit():
    with pytest.raises(ValueError, match="3 part labels for a track of 12 points"):
        articulated(track=track(), moving=torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match="3 part labels for no track"):
        articulated(moving=torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match="axis of a joint"):
        articulated(axis=(0, 0, 0))
