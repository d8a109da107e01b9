"""places: hands. What the residuals are told of where hands and objects are."""

from __future__ import annotations

import torch
from attention_scene import module, person, run, thing
from torch import Tensor

from hoigs.core.values.tokens import Role, Tokens


def test_adds_a_linear_map_of_hands_from_the_centre():
    """F' from the equation, plus W d + b with d in decimetres, world axes, left hand first."""
    made = module(gate="none", places="hands")
    ball = thing(7)
    tokens, _ = person()
    w_h, w_o = made.projections["human_96"].weight, made.projections["object_32"].weight
    q_h, k_h, v_h = (tokens.features @ w_h.T).chunk(3, -1)
    q_o, k_o, v_o = (ball.features @ w_o.T).chunk(3, -1)
    center = ball.positions.mean(0)
    offset = 10 * torch.cat([tokens.positions[part] - center for part in (8, 9)])
    f_h = v_h + torch.softmax(q_h @ k_o.T / 32**0.5, -1) @ v_o + made.places["human"](offset)
    f_o = v_o + torch.softmax(q_o @ k_h.T / 32**0.5, -1) @ v_h + made.places["object"](offset)
    out = run(made, ball)
    pose = 0.3 * torch.tanh(made.pose_head(f_h.flatten())).view(51, 3)
    torch.testing.assert_close(out["human"].pose, pose, atol=1e-5, rtol=1e-4)
    means = 0.1 * torch.tanh(made.means_head(f_o))
    torch.testing.assert_close(out["ball"].means, means, atol=1e-6, rtol=1e-4)


def test_without_it_places_say_nothing_but_the_gate():
    tokens, role = person()
    roles = {"human": role, "ball": Role("object")}
    ball = thing()
    apart = Tokens(tokens.features, tokens.positions + 0.05)
    for places, same in (("none", True), ("hands", False)):
        made = module(gate="none", places=places)
        first = made({"human": tokens, "ball": ball}, roles)
        other = made({"human": apart, "ball": ball}, roles)
        assert torch.equal(first["ball"].means, other["ball"].means) == same
        assert torch.equal(first["human"].pose, other["human"].pose) == same


def test_who_is_out_of_reach_adds_nothing():
    made = module(places="hands")
    tokens, role = person()
    other, far = person(3, place=(20.0, 0, 0))
    roles = {"human": role, "friend": far, "ball": Role("object"), "box": Role("object")}
    out = made(
        {"human": tokens, "friend": other, "ball": thing(), "box": thing(place=(0, 30.0, 0))}, roles
    )
    alone = run(made, thing())
    torch.testing.assert_close(out["ball"].means, alone["ball"].means)
    torch.testing.assert_close(out["human"].pose, alone["human"].pose)
    assert (out["friend"].pose == 0).all() and (out["box"].means == 0).all()


def test_places_carry_no_gradient_and_their_maps_learn():
    made = module(places="hands", object_residual="both")
    tokens, role = person()
    ball = thing()
    places = [x.clone().requires_grad_() for x in (tokens.positions, ball.positions)]
    out = made(
        {"human": Tokens(tokens.features, places[0]), "ball": Tokens(ball.features, places[1])},
        {"human": role, "ball": Role("object")},
    )
    (out["human"].pose.square().sum() + out["ball"].means.square().sum()).backward()
    assert all(x.grad is None for x in places)
    for name in ("human", "object"):
        assert made.places[name].weight.grad.abs().max() > 0


def jolted(places: str) -> float:
    """RMS of what is left of jolts at moments that were not trained on, over that of the jolts.

    Tokens differ from moment to moment in a way that tells nothing, as those of noisy planes; the
    hands jump, and the object, which its spline leaves where it was, ought to have jumped too.
    """
    g = torch.Generator().manual_seed(0)
    made = module(perturbed=False, gate="none", places=places)
    tokens, role = person()
    ball, roles = thing(8), {"human": role, "ball": Role("object")}
    ball = Tokens(0.1 * ball.features, ball.positions)
    jolts = torch.randn(50, 3, generator=g).clamp(-1.5, 1.5) * 0.03
    noise = torch.randn(50, 16, 96, generator=g)
    held = ball.positions.mean(0) + torch.tensor([[0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]])

    def predicted(i: int) -> Tensor:
        places = tokens.positions.clone()
        places[8:10] = held + jolts[i]
        now = Tokens(0.1 * (tokens.features + 0.3 * noise[i]), places)
        return made({"human": now, "ball": ball}, roles)["ball"].means

    adam = torch.optim.Adam(made.parameters(), 2e-3)
    for step in range(400):
        i = step % 40
        adam.zero_grad()
        (predicted(i) - jolts[i]).abs().mean().backward()
        adam.step()
    with torch.no_grad():
        left = torch.stack([predicted(i).mean(0) - jolts[i] for i in range(40, 50)])
    return float(left.norm() / jolts[40:].norm())


def test_an_object_follows_the_hands_at_unseen_moments():
    assert jolted("hands") < 0.5
    assert jolted("none") > 0.9
