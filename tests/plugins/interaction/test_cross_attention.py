"""interaction:cross-attention and interaction:none."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from hoigs.core.body import PART_NAMES
from hoigs.core.context import BuildContext
from hoigs.core.entity import Entity
from hoigs.core.features import Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Role
from hoigs.core.moment import BodyPose, Moment
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning
from hoigs.plugins.features.body_parts import BodyPartFeatures
from hoigs.plugins.features.spline_motion import SplineMotionFeatures
from hoigs.plugins.interaction.cross_attention import CrossAttention, CrossAttentionConfig
from hoigs.plugins.interaction.gates import DistanceGate
from hoigs.plugins.interaction.none import NoInteraction

ARM = 0.7


def module(perturbed: bool = True, widths=None, **settings) -> CrossAttention:
    torch.manual_seed(0)
    made = CrossAttention.from_config(CrossAttentionConfig(**settings), BuildContext())
    kinds = {"human": "human", "friend": "human", "ball": "object", "box": "object"}
    made.bind(
        widths or {"human": 96, "friend": 96, "ball": 32, "box": 32}, kinds | {"scene": "scene"}
    )
    if perturbed:
        with torch.no_grad():
            for parameter in made.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
    return made


def person(seed: int = 0, place=(0.0, 0, 0)) -> tuple[Tokens, Role]:
    g = torch.Generator().manual_seed(seed)
    place = torch.tensor(place)
    tokens = Tokens(torch.randn(16, 96, generator=g), place + 0.3 * torch.randn(16, 3, generator=g))
    anchors = place + torch.tensor(
        [[0.0, 0, 0], [0.7, 0.45, 0], [-0.7, 0.45, 0], [0.1, -0.95, 0], [-0.1, -0.95, 0]]
    )
    return tokens, Role("human", anchors, torch.tensor(ARM))


def thing(count: int = 20, seed: int = 1, place=(0.8, 0.5, 0)) -> Tokens:
    g = torch.Generator().manual_seed(seed)
    noise = 0.05 * torch.randn(count, 3, generator=g)
    return Tokens(torch.randn(count, 32, generator=g), torch.tensor(place) + noise - noise.mean(0))


def run(made: CrossAttention, ball: Tokens, **others):
    tokens, role = person()
    roles = {"human": role, "ball": Role("object"), "box": Role("object"), "friend": role}
    return made({"human": tokens, "ball": ball, **others}, roles)


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


@pytest.mark.parametrize("gate", ["hard", "soft"])
@pytest.mark.parametrize("granularity", ["object", "gaussian", "part"])
@pytest.mark.parametrize("object_residual", ["both", "per-gaussian"])
@pytest.mark.parametrize("pose_head", ["flat", "per-part"])
def test_out_of_reach_is_zero_with_finite_gradients(
    gate, granularity, object_residual, pose_head
):  # F32
    made = module(
        gate=gate, granularity=granularity, object_residual=object_residual, pose_head=pose_head
    )
    far = thing(place=(50.0, 0, 0))
    leaf = far.features.clone().requires_grad_()
    out = run(made, Tokens(leaf, far.positions))
    assert (out["human"].pose.abs() < 1e-12).all() and (out["ball"].means.abs() < 1e-12).all()
    (out["human"].pose.sum() + out["ball"].means.sum()).backward()
    assert torch.isfinite(leaf.grad).all() and (leaf.grad.abs() < 1e-12).all()
    for name, parameter in made.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name


def fly_by(gate: str) -> torch.Tensor:
    """Changes of the pose residual between frames while a ball crosses the reach."""
    made = module(gate=gate)
    poses = [
        run(made, thing(place=(0.8 + 0.02 * step, 0.45, 0)))["human"].pose for step in range(60)
    ]
    poses = torch.stack(poses)
    change = (poses[1:] - poses[:-1]).norm(dim=(1, 2))
    assert change.max() > 0.01  # it does cross
    return change


def test_soft_gate_does_not_pop():  # F33
    soft, hard = fly_by("soft"), fly_by("hard")
    assert (hard > 1e-4).sum() == 1  # the paper's threshold: everything in one frame
    assert soft.max() < 0.25 * hard.max()
    moving = soft[soft > 0.3 * soft.max()]  # where the gate goes from a tenth to nine tenths
    assert len(moving) > 8 and soft.max() < 2 * moving.median()
    assert (soft[1:] - soft[:-1]).abs().max() < 0.25 * soft.max()


def test_held_object_is_in_reach():  # F34
    """An object in an outstretched or raised hand, over a body that swings its arm."""

    def opened(reach_from: str) -> float:
        made = module(reach_from=reach_from, gate="hard")
        count = 0
        for angle in torch.linspace(-1.4, 1.4, 40):
            hand = torch.tensor([0.18, 0.45, 0]) + 0.62 * torch.stack(
                (angle.cos(), angle.sin(), torch.zeros(()))
            )
            tokens, role = person()
            anchors = role.anchors.clone()
            anchors[1] = hand - 0.1 * torch.nn.functional.normalize(hand, dim=0)
            roles = {"human": Role("human", anchors, role.reach), "ball": Role("object")}
            out = made({"human": tokens, "ball": thing(place=hand.tolist())}, roles)
            count += int(out["human"].pose.abs().max() > 0)
        return count / 40

    assert opened("nearest") == 1.0
    assert opened("pelvis") < 0.7  # the paper's rule loses what is held high


def test_tokens_of_an_object_may_be_shuffled():  # F36
    for granularity in ("object", "gaussian", "part"):
        made = module(granularity=granularity, object_residual="both")
        ball = thing(30)
        order = torch.randperm(30)
        plain = run(made, ball)
        shuffled = run(made, Tokens(ball.features[order], ball.positions[order]))
        torch.testing.assert_close(shuffled["human"].pose, plain["human"].pose)
        torch.testing.assert_close(shuffled["ball"].means, plain["ball"].means[order])


@pytest.mark.parametrize("gate", ["hard", "soft"])
def test_near_and_far_objects(gate):  # F39
    made = module(gate=gate)
    near, far = thing(10), thing(25, seed=4, place=(9.0, 0, 0))
    both, alone = run(made, near, box=far), run(made, near)
    assert (both["box"].means.abs() < 1e-12).all()
    assert both["ball"].means.abs().max() > 1e-3
    torch.testing.assert_close(both["human"].pose, alone["human"].pose)
    torch.testing.assert_close(both["ball"].means, alone["ball"].means)
    two = run(made, near, box=thing(25, seed=4))
    assert (two["human"].pose - alone["human"].pose).abs().max() > 1e-3  # both are attended to


def part_of_joint() -> list[int]:
    """By name: SMPL-X's joints 1..21, then 15 of each hand (methods C.9)."""
    names = (
        "left thigh", "right thigh", "belly", "left shin", "right shin", "belly", "left foot",
        "right foot", "chest", "left foot", "right foot", "head", "chest", "chest", "head",
        "left upper arm", "right upper arm", "left forearm", "right forearm", "left hand",
        "right hand", *("left hand",) * 15, *("right hand",) * 15,
    )  # fmt: skip
    return [PART_NAMES.index(name) for name in names]


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


def test_per_part_head_is_gated_by_each_part():
    made = module(pose_head="per-part", granularity="part", gate="hard")
    tokens, _ = person()
    hand = tokens.positions[PART_NAMES.index("left hand")]
    near = thing(place=hand.tolist())
    pose = run(made, near)["human"].pose
    reached = torch.cdist(tokens.positions, near.positions).amin(1) < ARM
    expected = reached[torch.tensor(part_of_joint())]
    assert torch.equal(pose.abs().amax(1) > 0, expected)
    assert expected.any() and not expected.all()


@pytest.mark.parametrize("granularity", ["object", "gaussian", "part"])
@pytest.mark.parametrize("reach_from", ["nearest", "pelvis"])
def test_gate_equals_its_formula(granularity, reach_from):
    """B_ij by the definition, pair by pair in float64, hard and soft."""
    (tokens, role), ball = person(), thing(9, place=(0.9, 0.2, 0.4))
    anchors, center = role.anchors.double(), ball.positions.double().mean(0)
    for reach in (1.0, 0.75):
        gates = {
            kind: DistanceGate(kind, granularity, reach_from, 0.1, reach).log(
                "human", role, tokens, ball
            )
            for kind in ("hard", "soft")
        }
        shut = 0
        for i in range(16):
            for j in range(9):
                at = center if granularity == "object" else ball.positions[j].double()
                start = anchors if reach_from == "nearest" else anchors[:1]
                if granularity == "part":
                    start = tokens.positions[i : i + 1].double()
                distance = min(float((a - at).norm()) for a in start)
                margin = reach * ARM - distance
                soft = 1 / (1 + math.exp(-margin / 0.1))
                assert float(gates["soft"][i, j].exp()) == pytest.approx(soft, rel=1e-4)
                assert float(gates["hard"][i, j]) == (0.0 if margin > 0 else -math.inf)
                shut += margin <= 0
        if (granularity, reach) == ("part", 1.0):
            assert 0 < shut < 16 * 9  # the only one that tells parts apart


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
    from hoigs.core.scene import SceneModel

    torch.manual_seed(0)
    human = Entity(
        toy_body.rest(60),
        HexPlaneSkinning(toy_body, resolution=8, time_resolution=4, field_points=160),
        BodyPartFeatures(),
    )
    cloud = Gaussians.from_points(torch.tensor([0.7, 0.4, 0.1]) + 0.05 * torch.randn(20, 3))
    ball = Entity(cloud, CubicHermite(keyframes=3), SplineMotionFeatures())

    class Unused:
        def render(self, *args):
            raise AssertionError("this test draws nothing")

    scene = SceneModel(
        {"human": human, "ball": ball}, interaction=CrossAttention(), rasterizer=Unused()
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
