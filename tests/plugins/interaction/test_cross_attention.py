"""The cross-attention module: its equation, heads and residuals, and what it owes as any module."""

from __future__ import annotations

import itertools

import pytest
import torch
from attention_scene import ARM, module, part_of_joint, person, run, thing

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Role, Tokens
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning
from hoigs.plugins.features.body_parts import BodyPartFeatures
from hoigs.plugins.features.spline_motion import SplineMotionFeatures
from hoigs.plugins.interaction.cross_attention import CrossAttention
from hoigs.plugins.interaction.none import NoInteraction
from hoigs.rasterizers.torch_tiles import TorchRasterizer


@pytest.mark.parametrize("count", [1, 16, 17, 500])
@pytest.mark.parametrize("values", ["gated", "swapped"])
@pytest.mark.parametrize("granularity", ["object", "gaussian", "part"])
@pytest.mark.parametrize("object_residual", ["per-gaussian", "rigid", "both"])
def test_shapes_bounds_and_finiteness(count, values, granularity, object_residual):  # F35
    made = module(values=values, granularity=granularity, object_residual=object_residual)
    out = run(made, thing(count))
    assert out["human"].pose.shape == (51, 3) and out["human"].means is None
    assert out["ball"].means.shape == (count, 3) and out["ball"].pose is None
    assert 0 < out["human"].pose.abs().max() <= 0.3
    assert 0 < out["ball"].means.abs().max() < 0.3
    assert torch.isfinite(out["ball"].means).all()


def test_saturated_heads_stay_within_their_bounds():  # F30
    made = module()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1e3)
    out, limits = run(made, thing(500)), made.config
    assert 0.97 * limits.pose_bound < out["human"].pose.abs().max() <= limits.pose_bound
    assert 0.9 * limits.means_bound < out["ball"].means.abs().max() <= limits.means_bound


def test_starts_without_effect():
    out = run(module(perturbed=False, object_residual="both"), thing())
    assert (out["human"].pose == 0).all() and (out["ball"].means == 0).all()


def test_equals_the_equation():
    made = module(gate="none")
    ball = thing(7)
    tokens, _ = person()
    w_h, w_o = made.projections["human_96"].weight, made.projections["object_32"].weight
    q_h, k_h, v_h = (tokens.features @ w_h.T).chunk(3, -1)
    q_o, k_o, v_o = (ball.features @ w_o.T).chunk(3, -1)
    f_h = v_h + torch.softmax(q_h @ k_o.T / 32**0.5, -1) @ v_o
    f_o = v_o + torch.softmax(q_o @ k_h.T / 32**0.5, -1) @ v_h
    out = run(made, ball)
    pose = 0.3 * torch.tanh(made.pose_head(f_h.flatten())).view(51, 3)
    torch.testing.assert_close(out["human"].pose, pose)
    torch.testing.assert_close(out["ball"].means, 0.1 * torch.tanh(made.means_head(f_o)))
    swapped = module(gate="none", values="swapped")
    pose = 0.3 * torch.tanh(swapped.pose_head((f_h - v_h).flatten())).view(51, 3)
    torch.testing.assert_close(run(swapped, ball)["human"].pose, pose)


def test_tokens_of_an_object_may_be_shuffled():  # F36
    for granularity in ("object", "gaussian", "part"):
        made = module(granularity=granularity, object_residual="both")
        ball = thing(30)
        order = torch.randperm(30)
        plain = run(made, ball)
        shuffled = run(made, Tokens(ball.features[order], ball.positions[order]))
        torch.testing.assert_close(shuffled["human"].pose, plain["human"].pose)
        torch.testing.assert_close(shuffled["ball"].means, plain["ball"].means[order])


def test_per_part_head_reads_each_joint_from_its_own_part():
    made = module(pose_head="per-part", values="gated", gate="none")
    tokens, role = person()
    ball = thing()
    plain = run(made, ball)["human"].pose
    w_h, w_o = made.projections["human_96"].weight, made.projections["object_32"].weight
    q_h, _, v_h = (tokens.features @ w_h.T).double().chunk(3, -1)
    _, k_o, v_o = (ball.features @ w_o.T).double().chunk(3, -1)
    f_h = v_h + torch.softmax(q_h @ k_o.T / 32**0.5, -1) @ v_o
    head = made.pose_head.double()
    rows = [
        0.3 * torch.tanh(head(f_h[part]).view(51, 3)[joint])
        for joint, part in enumerate(part_of_joint())
    ]
    torch.testing.assert_close(plain.double(), torch.stack(rows), atol=1e-5, rtol=0)
    made.pose_head.float()
    changed = tokens.features.clone()
    changed[PART_NAMES.index("left hand")] += 1.0
    roles = {"human": role, "ball": Role("object")}
    other = made({"human": Tokens(changed, tokens.positions), "ball": ball}, roles)["human"].pose
    moved = ((other - plain).abs().amax(1) > 1e-6).nonzero().squeeze(1).tolist()
    assert moved == [19, *range(21, 36)]  # the left wrist and hand, nothing else
    flat = module(gate="none")
    before = run(flat, ball)["human"].pose
    after = flat({"human": Tokens(changed, tokens.positions), "ball": ball}, roles)["human"].pose
    assert ((after - before).abs().amax(1) > 1e-6).all()


def test_two_humans():
    made = module()
    tokens, role = person()
    other, far_role = person(3, place=(20.0, 0, 0))
    roles = {"human": role, "friend": far_role, "ball": Role("object")}
    out = made({"human": tokens, "friend": other, "ball": thing()}, roles)
    alone = run(made, thing())
    assert (out["friend"].pose.abs() < 1e-12).all()
    torch.testing.assert_close(out["human"].pose, alone["human"].pose)
    torch.testing.assert_close(out["ball"].means, alone["ball"].means)


def test_one_side_alone_has_no_residual():
    made = module()
    tokens, role = person()
    assert made({"human": tokens}, {"human": role}) == {}
    assert made({"ball": thing()}, {"ball": Role("object")}) == {}
    assert NoInteraction()({"human": tokens, "ball": thing()}, {}) == {}


def test_rigid_residual_keeps_distances():
    made = module(object_residual="rigid")
    ball = thing(12)
    moved = ball.positions + run(made, ball)["ball"].means
    assert (moved - ball.positions).abs().max() > 1e-3
    torch.testing.assert_close(
        torch.cdist(moved, moved), torch.cdist(ball.positions, ball.positions), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("kind", ["per-gaussian", "rigid", "both"])
def test_object_residual_equals_its_formula(kind):
    """delta G from the module's own F'_O, in float64: heads, bounds, a turn about the centre."""
    made = module(object_residual=kind, gate="soft", granularity="gaussian")
    ball = thing(11)
    tokens, role = person()
    found = run(made, ball)["ball"].means
    made = made.double()
    w_h, w_o = made.projections["human_96"].weight, made.projections["object_32"].weight
    _, k_h, v_h = (tokens.features.double() @ w_h.T).chunk(3, -1)
    q_o, _, v_o = (ball.features.double() @ w_o.T).chunk(3, -1)
    distance = torch.cdist(role.anchors, ball.positions).amin(0).double()
    gate = torch.sigmoid((ARM - distance) / 0.05)  # the same for every part of a row
    attended = v_o + gate[:, None] * (torch.softmax(q_o @ k_h.T / 32**0.5, -1) @ v_h)
    expected = torch.zeros(11, 3, dtype=torch.float64)
    if kind != "rigid":
        expected += gate[:, None] * 0.1 * torch.tanh(made.means_head(attended))
    if kind != "per-gaussian":
        twist = gate.max() * torch.tanh(made.twist_head(attended.mean(0)))
        x, y, z = 0.3 * twist[:3]
        cross = torch.zeros(3, 3, dtype=torch.float64)
        cross[0, 1], cross[0, 2], cross[1, 2] = -z, y, -x
        turn = torch.matrix_exp(cross - cross.T)
        arms = ball.positions.double() - ball.positions.double().mean(0)
        expected += arms @ turn.T - arms + 0.1 * twist[3:]
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-4)
    assert found.abs().max() > 1e-3


def test_every_parameter_learns_and_gates_do_not():
    made = module(object_residual="both", granularity="gaussian")
    tokens, role = person()
    ball = thing()
    leaves = [x.clone().requires_grad_() for x in (tokens.features, ball.features)]
    places = [x.clone().requires_grad_() for x in (tokens.positions, ball.positions)]
    out = made(
        {"human": Tokens(leaves[0], places[0]), "ball": Tokens(leaves[1], places[1])},
        {"human": role, "ball": Role("object")},
    )
    g = torch.Generator().manual_seed(9)
    (out["human"].pose * torch.randn(51, 3, generator=g)).sum().backward(retain_graph=True)
    (out["ball"].means * torch.randn(20, 3, generator=g)).sum().backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
    assert all(x.grad.abs().max() > 0 for x in leaves)
    assert all(x.grad is None for x in places)


@pytest.mark.parametrize("values", ["gated", "swapped"])
def test_gradcheck(values):
    made = module(values=values, width=4, hidden=6, object_residual="both").double()
    tokens, role = person()
    role = Role("human", role.anchors.double(), role.reach.double())
    ball = thing(3)

    def outputs(human, obj):
        out = made(
            {
                "human": Tokens(human, tokens.positions.double()),
                "ball": Tokens(obj, ball.positions.double()),
            },
            {"human": role, "ball": Role("object")},
        )
        return out["human"].pose, out["ball"].means

    leaves = [x.double().requires_grad_() for x in (tokens.features, ball.features)]
    assert torch.autograd.gradcheck(outputs, leaves, fast_mode=True)


def test_errors_speak():
    made = module()
    tokens, role = person()
    roles = {"human": role, "ball": Role("object")}
    few = Tokens(tokens.features[:5], tokens.positions[:5])
    with pytest.raises(ValueError, match='"human" has 5 tokens; a human needs 16'):
        made({"human": few, "ball": thing()}, roles)
    roles["human"] = Role("human")
    with pytest.raises(ValueError, match='"human" has no skeleton'):
        made({"human": tokens, "ball": thing()}, roles)
    out = module(gate="none")({"human": tokens, "ball": thing()}, roles)
    assert out["human"].pose.abs().max() > 0


def test_whole_forward_pass_of_a_scene(toy_body, toy_pose):
    """Features, interaction and deformations in a SceneModel, gradients end to end."""
    from hoigs.core.model.scene import SceneModel

    torch.manual_seed(0)
    human = Entity(
        toy_body.canonical(60),
        HexPlaneSkinning(
            HexPlaneSkinning.Config(
                resolution=8, time_resolution=4, field_points=160, refine_poses=False
            ),
            body=toy_body,
        ),
        BodyPartFeatures(),
    )
    cloud = Gaussians.from_points(torch.tensor([0.7, 0.4, 0.1]) + 0.05 * torch.randn(20, 3))
    ball = Entity(cloud, CubicHermite(CubicHermite.Config(keyframes=3)), SplineMotionFeatures())

    scene = SceneModel(
        {"human": human, "ball": ball}, interaction=CrossAttention(), rasterizer=TorchRasterizer()
    )
    moment = Moment(0.4, poses={"human": BodyPose.zeros(betas=2)})
    before = scene(moment)
    assert set(before.residuals) == {"human", "ball"}
    with torch.no_grad():
        for parameter in scene.interaction.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    state = scene(moment)
    for name in ("human", "ball"):
        moved = (state.gaussians[name].means - before.gaussians[name].means).norm(dim=-1)
        assert moved.max() > 1e-3
    sum(g.means.square().sum() for g in state.gaussians.values()).backward()
    for name, parameter in itertools.chain(
        scene.interaction.named_parameters(), ball.features.named_parameters()
    ):
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
    assert human.deformation.planes.time.grad.abs().max() > 0  # phi reaches the pose residual
