"""Light by the direction in which a surface faces."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.maths.spherical_harmonics import irradiance_basis
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.articulated import Articulated
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning, HexPlaneSkinningConfig
from hoigs.plugins.deformation.irradiance import TERMS, Irradiance, outward_normals, turned_normals
from hoigs.plugins.deformation.keyframes import Keyframed
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.plugins.deformation.tracked_chs import TrackedHermite

TURNS = torch.tensor([[0.0, 0, 0], [0.0, 0, 1.2], [0.0, 0, 2.4]])  # of the ball, radians
SUN = normalize(torch.tensor([0.3, 0.8, -0.5]), dim=0)


def sphere(count: int) -> torch.Tensor:
    """Points spread evenly over the unit sphere (Fibonacci)."""
    k = torch.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn, radius = k * torch.pi * (3 - 5**0.5), (1 - z * z).sqrt()
    return torch.stack((radius * turn.cos(), radius * turn.sin(), z), -1)


def ball(count: int = 60) -> Gaussians:
    points = sphere(count)
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    flat = Gaussians.from_points(points, colors, scales=0.1, thickness=0.1, normals=points)
    return flat.replace(sh=torch.cat((flat.sh, 0.1 * torch.randn(count, 3, 3)), 1))


def test_the_terms_are_orthogonal_harmonics():
    terms = irradiance_basis(sphere(4000))
    products = terms.mT @ terms / len(terms)
    assert terms.shape[1] == TERMS
    assert terms.mean(0).abs().max() < 1e-3  # none is a constant, which colours have already
    assert (products - products.diagonal().diag()).abs().max() < 1e-3


def test_they_hold_the_light_of_a_sun_and_a_sky():
    """Ramamoorthi and Hanrahan: within 2 % of the energy, for Lambert's cosine."""
    normals = sphere(4000)
    light = (normals @ SUN).clamp_min(0) + 0.3 + 0.2 * normals[:, 1]
    terms = torch.cat((torch.ones(len(normals), 1), irradiance_basis(normals)), 1)
    fitted = terms @ torch.linalg.lstsq(terms, light[:, None]).solution[:, 0]
    assert (fitted - light).square().sum() < 0.02 * light.square().sum()
    assert (fitted - light).square().sum() > 1e-6 * light.square().sum()


def test_normals_turn_with_their_gaussians():
    before, after = torch.randn(9, 4), torch.randn(9, 4)
    normals = normalize(torch.randn(9, 3), dim=-1)
    turns = quats_to_matrices(after) @ quats_to_matrices(before).mT
    expected = (turns @ normals[..., None])[..., 0]
    torch.testing.assert_close(
        turned_normals(normals, before, after), expected, atol=1e-5, rtol=1e-5
    )


def test_normals_of_a_closed_surface_point_outwards():
    flat = ball()
    moved = flat.replace(means=flat.means + torch.tensor([5.0, -2.0, 1.0]))
    torch.testing.assert_close(outward_normals(moved), flat.means, atol=1e-4, rtol=0)
    points = sphere(2000)
    round_ones = Gaussians.from_points(points, scales=0.02)
    assert ((outward_normals(round_ones) * points).sum(-1) > 0.99).all()


@torch.no_grad()
def test_it_scales_all_harmonics_of_a_colour():
    module, gaussians = Irradiance(), ball()
    assert torch.equal(module(gaussians, gaussians.means).sh, gaussians.sh)
    module.light.normal_(std=0.3)
    lit = module(gaussians, gaussians.means)
    factors = 1 + irradiance_basis(gaussians.means) @ module.light
    torch.testing.assert_close(lit.colors, factors * gaussians.colors)
    torch.testing.assert_close(lit.sh[:, 1:], factors[:, None] * gaussians.sh[:, 1:])
    assert torch.equal(lit.means, gaussians.means)


def turning_ball(motion: type[Keyframed] = TrackedHermite, **settings) -> Entity:
    torch.manual_seed(0)
    turns = axis_angle_to_matrices(TURNS)
    flat = ball()
    track = ObjectTrack(
        flat.means, flat.colors, turns, torch.zeros(3, 3), torch.ones(3, dtype=torch.bool)
    )
    config = motion.Config(keyframes=9, **settings)
    return Entity(flat, motion(config, track=track))


def test_a_turning_object_learns_its_light():
    """Colours of the ball at three turns determine the light and its own colours."""
    entity = turning_ball(light=True)
    normals = entity.canonical.means.detach()
    turns = axis_angle_to_matrices(TURNS)
    truth = torch.tensor([0.4, -0.2, 0.3, 0.1, -0.1, 0.15, 0.05, 0.08])
    targets = []
    for frame in range(3):
        turned = normals @ turns[frame].mT
        factors = 1 + irradiance_basis(turned) @ truth
        targets.append(factors[:, None] * entity.canonical.colors.detach())
    optimizer = torch.optim.Adam([entity.deformation.irradiance.light], lr=0.02)
    for step in range(400):
        optimizer.zero_grad()
        moment = Moment(step % 3 / 2)
        loss = (entity(moment).colors - targets[step % 3]).square().mean()
        loss.backward()
        optimizer.step()
    for frame in range(3):
        error = (entity(Moment(frame / 2)).colors - targets[frame]).abs().mean()
        assert error < 0.01
    torch.testing.assert_close(
        entity.deformation.irradiance.light[:2, 0], truth[:2], atol=0.03, rtol=0
    )


def test_children_have_the_normals_of_their_parents():
    entity = turning_ball(light=True)
    change = TopologyChange(
        torch.tensor([3, 3, 7]), torch.zeros(3, dtype=torch.bool), torch.zeros(3, 3)
    )
    normals = entity.deformation.normals.detach()[change.source]
    entity.apply_topology(change, entity.canonical.detach()[change.source])
    assert torch.equal(entity.deformation.normals, normals)
    assert len(entity(Moment(0.5)).sh) == 3


@pytest.mark.parametrize("motion", [CubicHermite, TrackedHermite, RigidSpline, Articulated])
def test_objects_of_any_keyframed_motion_are_lit_as_they_turn(motion):
    entity = turning_ball(motion, light=True)
    with torch.no_grad():
        entity.deformation.irradiance.light[0] = 0.5
        turned = axis_angle_to_matrices(TURNS)[2]
        lit = entity(Moment(1.0)).colors / entity.canonical.colors
    expected = 1 + 0.5 * (entity.canonical.means.detach() @ turned.mT)[:, :1].expand(-1, 3)
    torch.testing.assert_close(lit, expected, atol=0.02, rtol=0)
    unlit = turning_ball(motion)
    assert unlit.deformation.irradiance is None
    assert torch.equal(unlit(Moment(1.0)).sh, unlit.canonical.sh)


@pytest.fixture
def person(toy_body) -> Entity:
    torch.manual_seed(0)
    config = HexPlaneSkinningConfig(
        resolution=8, channels=4, field_points=160, refine_poses=False, light=True
    )
    model = HexPlaneSkinning(config, body=toy_body, num_frames=9)
    return Entity(toy_body.canonical(200, model.betas, model.seed), model)


@torch.no_grad()
def test_a_person_is_lit_by_where_the_skin_faces(person, toy_pose):
    """Turning the whole body turns its normals: the same as turning the light the other way."""
    light = person.deformation.irradiance.light
    light[:3] = SUN[:, None]
    pose, turn = toy_pose(2), torch.tensor([0.0, torch.pi / 2, 0.0])
    still, turned = (pose.replace(global_orient=x) for x in (torch.zeros(3), turn))
    after = person(Moment(0.4, poses={"human": turned})).sh
    light[:3] = (axis_angle_to_matrices(turn).mT @ SUN)[:, None]
    torch.testing.assert_close(
        person(Moment(0.4, poses={"human": still})).sh, after, atol=1e-4, rtol=1e-4
    )
    light[:3] = SUN[:, None]
    apart = person(Moment(0.4, poses={"human": still})).sh - after
    assert apart.abs().max() > 0.1
    posed = person(Moment(0.4, poses={"human": still}))
    facing = (
        1 + turned_normals(person.deformation.normals, person.canonical.quats, posed.quats) @ SUN
    )
    bare = person.deformation.irradiance
    person.deformation.irradiance = None
    unlit = person(Moment(0.4, poses={"human": still}))
    person.deformation.irradiance = bare
    torch.testing.assert_close(posed.colors, facing[:, None] * unlit.colors, atol=1e-4, rtol=1e-4)
