"""What a person of deformation:hexplane-skinning does beside following the skeleton."""

from __future__ import annotations

import copy

import pytest
import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import SH_C0
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning, HexPlaneSkinningConfig
from hoigs.plugins.deformation.nonrigid import LEAST, NonRigidConfig, NonRigidMotion, Shading

COUNT, NUM_FRAMES = 200, 32


def human(toy_body, nonrigid: bool | str) -> Entity:
    torch.manual_seed(0)
    config = HexPlaneSkinningConfig(
        resolution=16, channels=4, field_points=160, refine_poses=False, nonrigid=nonrigid
    )
    model = HexPlaneSkinning(config, body=toy_body, num_frames=NUM_FRAMES)
    return Entity(toy_body.canonical(COUNT, model.betas, model.seed), model)


@pytest.fixture
def entity(toy_body) -> Entity:
    return human(toy_body, True)


@pytest.fixture
def shaded(toy_body) -> Entity:
    return human(toy_body, "shading")


def learned(entity: Entity) -> Entity:
    """The same with motion and colours that differ from cell to cell and from time to time."""
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in entity.deformation.nonrigid.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return entity


@pytest.mark.parametrize("kind", [True, "shading"])
def test_it_starts_by_changing_nothing(toy_body, toy_pose, kind):
    entity = human(toy_body, kind)
    moment = Moment(0.3, poses={"human": toy_pose(1)})
    with_it = entity(moment)
    entity.deformation.nonrigid = None
    without = entity(moment)
    for field in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        torch.testing.assert_close(getattr(with_it, field), getattr(without, field))


@torch.no_grad()
def test_a_pose_may_look_different_at_another_time(entity, toy_pose):
    learned(entity)
    pose = toy_pose(1)
    first, second = (entity(Moment(time, poses={"human": pose})) for time in (0.2, 0.7))
    assert (first.means - second.means).norm(dim=-1).median() > 1e-3
    assert (first.sh - second.sh)[:, 0].abs().median() > 1e-3
    assert torch.equal(first.log_scales, second.log_scales)
    template = entity.deformation.template(entity.canonical)
    rest = copy.deepcopy(entity)
    rest.deformation.nonrigid = None
    torch.testing.assert_close(  # what the template is of has no time
        template.gaussians.means, rest.deformation.template(rest.canonical).gaussians.means
    )


@torch.no_grad()
def test_offsets_are_canonical(entity, toy_pose):
    """A body that turns takes its clothes along."""
    learned(entity)
    pose, turn = toy_pose(2), torch.tensor([0.0, torch.pi / 2, 0.0])
    still = pose.replace(global_orient=torch.zeros(3))
    turned = pose.replace(global_orient=turn)
    rigid = copy.deepcopy(entity)
    rigid.deformation.nonrigid = None
    moved = [
        entity(Moment(0.4, poses={"human": p})).means - rigid(Moment(0.4, poses={"human": p})).means
        for p in (still, turned)
    ]
    matrix = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    torch.testing.assert_close(moved[1], moved[0] @ matrix.mT, atol=1e-5, rtol=0)


@pytest.mark.parametrize("frames", [1, 8, 64])
@torch.no_grad()
def test_a_frame_in_between_takes_what_its_neighbours_learned(frames):
    """Features are linear in time within a cell, which is some frames long."""
    motion = NonRigidMotion(NonRigidConfig(frames=2, resolution=8), frames)
    cells = max(LEAST, frames // 2)
    assert motion.planes.time.shape[1] == cells
    motion.planes.time.add_(torch.randn_like(motion.planes.time))
    points = torch.rand(20, 3) * 2 - 1
    at = [motion.planes(points, (1 + share) / (cells - 1)) for share in (0.25, 0.5, 0.75)]
    torch.testing.assert_close(at[1], (at[0] + at[2]) / 2, atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_shading_makes_colours_lighter_or_darker_and_moves_nothing(shaded, toy_pose):
    learned(shaded)
    moment = Moment(0.4, poses={"human": toy_pose(1)})
    lit = shaded(moment)
    shaded.deformation.nonrigid = None
    plain = shaded(moment)
    for field in ("means", "quats", "log_scales", "opacity_logits"):
        assert torch.equal(getattr(lit, field), getattr(plain, field)), field
    colors, before = (0.5 + SH_C0 * gaussians.sh[:, 0] for gaussians in (lit, plain))
    factors = colors / before
    assert (factors.amax(1) / factors.amin(1)).max() < 1.001  # of all channels alike
    assert factors.min() > 0 and factors.std() > 0.01


@torch.no_grad()
def test_shading_is_of_every_harmonic(shaded):
    canonical = shaded.canonical.replace(sh=torch.randn(COUNT, 4, 3))
    learned(shaded)
    points = torch.rand(COUNT, 3) * 2 - 1
    module = shaded.deformation.nonrigid
    assert isinstance(module, Shading)
    delta, changes = module.change(canonical, points, 0.4)
    expected = changes["shading"].expm1()[..., None] * canonical.sh[:, 1:]
    torch.testing.assert_close(delta.sh[:, 1:], expected)


@pytest.mark.parametrize(("kind", "penalised"), [(True, "nonrigid"), ("shading", "shading")])
def test_the_penalty_is_of_what_it_changes(toy_body, toy_pose, kind, penalised):
    entity = learned(human(toy_body, kind))
    moment = Moment(0.4, poses={"human": toy_pose(1)})
    model = entity.deformation
    drawn = entity(moment)
    loss = drawn.means.sum() + drawn.sh.sum()
    points = (entity.canonical.means - model.rest_joints[0]) / model.half_box
    _, changes = model.nonrigid.change(entity.canonical, points, 0.4)
    penalties = model.regularizers()
    expected = changes[penalised].square().sum(-1).mean()
    torch.testing.assert_close(penalties[penalised], expected)
    (loss + sum(penalties.values())).backward()
    assert penalised not in model.regularizers()  # its graph is used up
    copy.deepcopy(model)


@torch.no_grad()
def test_what_is_held_for_playback_still_moves(entity, toy_pose):
    learned(entity).eval()
    moments = [Moment(t, poses={"human": toy_pose(1)}) for t in (0.1, 0.8)]
    plain = [entity(m) for m in moments]
    entity.deformation.hold(entity.canonical, moments[0])
    for moment, expected in zip(moments, plain, strict=True):
        torch.testing.assert_close(entity(moment).means, expected.means)
        torch.testing.assert_close(entity(moment).sh, expected.sh)
