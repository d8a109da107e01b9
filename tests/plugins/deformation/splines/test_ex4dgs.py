"""deformation:ex4dgs and deformation:linear-displacement."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.interfaces.deformation import StepStatistics
from hoigs.core.maths.rotations import axis_angle_to_quats, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.zoo.ex4dgs import (
    Ex4dgs,
    LinearDisplacement,
    log_presence,
    scaled_logits,
    slerp_without_check,
)

CAMERA = Camera.look_at(torch.tensor([0.0, 0, -4]), torch.zeros(3), width=64, height=64, fov_y=0.8)


def cloud(count: int = 50, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = 0.5 * torch.randn(count, 3, generator=generator, dtype=dtype)
    return Gaussians.from_points(points, torch.rand(count, 3, generator=generator), scales=0.05)


def statistics(count: int, step: int, radii: torch.Tensor | None = None) -> StepStatistics:
    radii = torch.ones(count) if radii is None else radii
    return StepStatistics(Moment(0.5), CAMERA, torch.tensor(0.1), None, radii, step, 1000)


def moving(count: int = 50, promoted: int = 0, **settings: object) -> Entity:
    entity = Entity(cloud(count), Ex4dgs(Ex4dgs.Config(**settings), num_frames=41))
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        entity.deformation.displacement.copy_(torch.randn(count, 3, generator=generator))
    if promoted:
        rows = torch.arange(count)[:: count // promoted][:promoted]
        entity.deformation.promote(entity.canonical.detach(), rows)
    return entity


def shaken(entity: Entity) -> Entity:
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for parameter in entity.deformation.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    return entity


def test_lines_are_exact_and_held():
    entity = Entity(cloud(), LinearDisplacement())
    assert torch.equal(entity(Moment(0.7)).means, entity.means)
    with torch.no_grad():
        entity.deformation.displacement.fill_(2.0)
    torch.testing.assert_close(entity(Moment(0.25)).means, entity.means + 0.5)
    torch.testing.assert_close(entity(Moment(3.0)).means, entity.means + 2.0)
    torch.testing.assert_close(entity(Moment(-1.0)).means, entity.means)
    torch.testing.assert_close(
        entity.deformation.velocity(entity.canonical, Moment(0.2)), torch.full((50, 3), 2.0)
    )
    expected = math.log(12**0.5 + 0.001)
    assert entity.regularizers()["displacement"].item() == pytest.approx(expected)


def test_promotion_changes_no_place():
    entity = moving()
    times = [0.0, 0.13, 0.5, 0.77, 1.0]
    before = [entity(Moment(t)) for t in times]
    rows = torch.tensor([3, 17, 40])
    entity.deformation.promote(entity.canonical.detach(), rows)
    entity.deformation.promote(entity.canonical.detach(), torch.tensor([20]))
    assert entity.deformation.rows.tolist() == [3, 17, 20, 40]
    for time, old in zip(times, before, strict=True):
        new = entity(Moment(time))
        torch.testing.assert_close(new.means, old.means, atol=1e-5, rtol=0)
        torch.testing.assert_close(new.quats, old.quats)
        assert (new.opacities - old.opacities).abs().max() < 0.01 * 0.1 * 10


def test_the_fastest_seen_two_percent_are_promoted_on_schedule():
    entity = moving(100, promote=0.05, promote_from=10, promote_every=5)
    model = entity.deformation
    radii = torch.ones(100)
    radii[::2] = 0  # not drawn: not promoted
    canonical = entity.canonical.detach()
    assert model.evolve(canonical, statistics(100, 9, radii)) == {}
    assert model.evolve(canonical, statistics(100, 11, radii)) == {}
    changes = model.evolve(canonical, statistics(100, 10, radii))
    distance = (canonical.means - CAMERA.center).square().sum(-1)
    score = model.displacement.detach().norm(dim=-1) / distance
    score[::2] = -1
    expected = score.argsort(descending=True)[: round(0.05 * 50)].sort().values
    assert model.rows.tolist() == expected.tolist()
    assert set(changes) == {"keyframe_means", "keyframe_quats", "centers", "log_widths"}
    assert changes["centers"].fresh.all()
    first = model.rows.clone()
    changes = model.evolve(canonical, statistics(100, 15, radii))
    assert set(first.tolist()) < set(model.rows.tolist())
    kept = ~changes["centers"].fresh
    assert model.rows[kept].tolist() == first.tolist()


def test_what_stands_still_is_not_promoted():
    entity = Entity(cloud(), Ex4dgs(Ex4dgs.Config(promote_from=1, promote_every=1), num_frames=41))
    assert entity.deformation.evolve(entity.canonical.detach(), statistics(50, 1)) == {}


def test_keyframes_are_interpolated_by_central_differences():
    entity = shaken(moving(6, promoted=2, interval=4, pad=1))
    model = entity.deformation
    for frame in (0, 3, 17, 40):
        position = (frame + 1 + 4) / 4
        k = int(position)
        r = position - k
        m = model.keyframe_means
        before, after = (m[:, k + 1] - m[:, k - 1]) / 2, (m[:, k + 2] - m[:, k]) / 2
        expected = (
            (2 * r**3 - 3 * r**2 + 1) * m[:, k]
            + (r**3 - 2 * r**2 + r) * before
            + (3 * r**2 - 2 * r**3) * m[:, k + 1]
            + (r**3 - r**2) * after
        )
        means = entity(Moment(frame / 40)).means
        torch.testing.assert_close(means[model.rows], expected, atol=1e-5, rtol=1e-5)
    assert torch.equal(entity(Moment(1.0)).means, entity(Moment(9.0)).means)
    for frames in (1, 2, 9, 10, 11, 300):  # the knots reach beyond the last frame, always
        short = Entity(cloud(4), Ex4dgs(num_frames=frames))
        short.deformation.promote(short.canonical.detach(), torch.tensor([1]))
        assert torch.isfinite(short(Moment(1.0)).means).all()


def test_presence_in_time_and_its_published_jump():
    centers = torch.tensor([[2.0, 5.0], [5.0, 2.0]])
    widths = torch.tensor([[0.0, 1.0], [0.0, 1.0]])

    def presence(time: float, jump: bool) -> torch.Tensor:
        return log_presence(centers, widths, time, 0.1, jump=jump).exp()

    for time in (2.5, 4.9):
        assert (presence(time, False) == 1).all() and (presence(time, True) == 1).all()
    after = math.exp(-((1.5 / (math.e + 0.1)) ** 2))
    torch.testing.assert_close(presence(6.5, False), torch.full((2,), after))
    torch.testing.assert_close(presence(6.5, True), torch.full((2,), after))
    before = math.exp(-((0.5 / 1.1) ** 2))
    torch.testing.assert_close(presence(1.5, False), torch.full((2,), before))
    torch.testing.assert_close(presence(1.5, True), torch.full((2,), math.exp(-((3.5 / 1.1) ** 2))))
    # the slip: just before the first centre it is almost gone, and at the centre whole
    assert (presence(1.9999, False) > 0.999).all() and (presence(1.9999, True) < 0.001).all()


def test_scaled_logits_are_those_of_the_scaled_opacity():
    logits = torch.tensor([-3.0, 0.0, 4.0, 30.0], dtype=torch.float64)
    for factor in (1.0, 0.7, 0.01):
        scaled = scaled_logits(logits, torch.full((4,), math.log(factor), dtype=torch.float64))
        torch.testing.assert_close(scaled.sigmoid(), logits.sigmoid() * factor, rtol=1e-5, atol=0)
    logits = torch.tensor([5.0, 30.0], requires_grad=True)
    far = torch.tensor([-1e4, -1e-9], requires_grad=True)
    scaled_logits(logits, far).sum().backward()
    assert torch.isfinite(logits.grad).all() and torch.isfinite(far.grad).all()


def test_rotations_without_the_hemisphere_check_go_the_long_way():
    half = torch.tensor([[1.0, 0, 0, 0]])
    quarter = axis_angle_to_quats(torch.tensor([[0.0, 0, 1.0]]))
    short = slerp_without_check(half, quarter, 0.5)
    torch.testing.assert_close(short, axis_angle_to_quats(torch.tensor([[0.0, 0, 0.5]])))
    long = slerp_without_check(half, -quarter, 0.5)
    angle = 0.5 - math.pi  # half of the turn of 2 pi - 1 the other way
    expected = quats_to_matrices(axis_angle_to_quats(torch.tensor([[0.0, 0, angle]])))
    torch.testing.assert_close(quats_to_matrices(long), expected, atol=1e-5, rtol=0)
    for hemisphere, flips in ((True, False), (False, True)):
        entity = shaken(moving(4, promoted=2, hemisphere=hemisphere))
        before = quats_to_matrices(entity(Moment(0.4)).quats)
        with torch.no_grad():
            entity.deformation.keyframe_quats[:, ::2] *= -1
        after = quats_to_matrices(entity(Moment(0.4)).quats)
        assert ((after - before).abs().max() > 0.1) == flips


def test_every_parameter_learns():
    entity = shaken(moving(6, promoted=3))
    with torch.no_grad():
        entity.deformation.centers[:, 0] += 1.5
        entity.deformation.centers[:, 1] -= 1.5
    weights = torch.randn(6, 4, generator=torch.Generator().manual_seed(3))
    total = torch.zeros(())
    for i in range(41):
        out = entity(Moment(i / 40))
        total = total + out.means.square().sum() + (out.quats * weights).sum()
        total = total + out.opacities.sum()
    (total + sum(entity.regularizers().values())).backward()
    for name, parameter in entity.deformation.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name
        assert (parameter.grad.flatten(1).abs().sum(1) > 0).all(), name


def test_rows_follow_density_control():
    entity = shaken(moving(10, promoted=5))  # rows 0, 2, 4, 6, 8
    model = entity.deformation
    old = {n: p.detach().clone() for n, p in model.named_parameters()}
    change = TopologyChange(
        source=torch.tensor([1, 2, 4, 5, 8, 8, 3]),
        fresh=torch.tensor([False, False, False, False, False, True, True]),
        offsets=torch.tensor([[0.0, 0, 0]] * 5 + [[0.1, 0.2, 0.3]] * 2),
    )
    followed = model.axis_changes(change)["keyframe_means"]
    assert followed.fresh.tolist() == [False, False, False, True]
    torch.testing.assert_close(
        followed.follow(old["keyframe_means"])[:3], old["keyframe_means"][[1, 2, 4]]
    )
    canonical = entity.canonical.detach()[change.source]
    entity.apply_topology(change, canonical.replace(means=canonical.means + change.offsets))
    assert model.rows.tolist() == [1, 2, 4, 5]
    torch.testing.assert_close(model.keyframe_quats.data, old["keyframe_quats"][[1, 2, 4, 4]])
    torch.testing.assert_close(model.keyframe_means[:3].data, old["keyframe_means"][[1, 2, 4]])
    length = (model.keyframe_means[3] - old["keyframe_means"][4]).norm(dim=-1)
    torch.testing.assert_close(length, torch.full_like(length, 0.14**0.5), atol=1e-5, rtol=0)
    torch.testing.assert_close(model.displacement.data, old["displacement"][change.source])
    residual = Residual(means=torch.ones(7, 3))
    moved = entity(Moment(0.3), residual).means
    torch.testing.assert_close(moved, entity(Moment(0.3)).means + 1)
