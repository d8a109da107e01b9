"""Who is in whose reach: gates of the cross-attention module, and what they shut."""

from __future__ import annotations

import math

import pytest
import torch
from attention_scene import ARM, module, part_of_joint, person, run, thing

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.values.tokens import Role, Tokens
from hoigs.plugins.interaction.cross_attention import DistanceGateConfig, log_gate


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
            kind: log_gate(
                DistanceGateConfig(
                    gate=kind,
                    granularity=granularity,
                    reach_from=reach_from,
                    softness=0.1,
                    reach=reach,
                ),
                "human",
                role,
                tokens,
                ball,
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
