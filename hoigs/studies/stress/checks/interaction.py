"""F30, F32 to F36, F39: direct checks of the interaction module with random tokens."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.tokens import Residual, Role, Tokens
from hoigs.studies.stress.case import CheckResult
from hoigs.studies.stress.checks.toy import component

ARM = 0.7  # metres
WIDTHS = {"human": 96, "ball": 32, "box": 32}
KINDS = {"human": "human", "ball": "object", "box": "object"}
HANDS = [[0.0, 0, 0], [0.7, 0.45, 0], [-0.7, 0.45, 0], [0.1, -0.95, 0], [-0.1, -0.95, 0]]


def _module(**settings: object) -> Any:
    """Cross-attention with random parameters, so that residuals are not zero."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        made = component("interaction:cross-attention", **settings)
        made.bind(WIDTHS, KINDS)
        with torch.no_grad():
            for parameter in made.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
    return made


def _person(anchors: Float[Tensor, "A 3"] | None = None) -> tuple[Tokens, Role]:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(16, 96, generator=generator)
    tokens = Tokens(features, 0.3 * torch.randn(16, 3, generator=generator))
    anchors = torch.tensor(HANDS) if anchors is None else anchors
    return tokens, Role("human", anchors, torch.tensor(ARM))


def _thing(count: int = 20, seed: int = 1, place: tuple[float, ...] = (0.8, 0.5, 0.0)) -> Tokens:
    generator = torch.Generator().manual_seed(seed)
    noise = 0.05 * torch.randn(count, 3, generator=generator)
    features = torch.randn(count, 32, generator=generator)
    return Tokens(features, torch.tensor(place) + noise - noise.mean(0))


def _run(
    made: Any, ball: Tokens, box: Tokens | None = None, role: Role | None = None
) -> dict[str, Residual]:
    tokens, usual = _person()
    roles = {"human": role or usual, "ball": Role("object"), "box": Role("object")}
    described = {"human": tokens, "ball": ball} | ({} if box is None else {"box": box})
    return dict(made(described, roles))


def _pose(residuals: dict[str, Residual]) -> Float[Tensor, "51 3"]:
    pose = residuals["human"].pose
    assert pose is not None
    return pose


def _means(residuals: dict[str, Residual], name: str = "ball") -> Float[Tensor, "N 3"]:
    means = residuals[name].means
    assert means is not None
    return means


def _largest(values: Tensor) -> float:
    return float(values.detach().abs().max())


def bounded_pose() -> CheckResult:
    """Saturated heads: no correction exceeds its bound."""
    made = _module()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(1e3)
    out = _run(made, _thing(500))
    pose, means = _largest(_pose(out)), _largest(_means(out))
    limits = made.config
    passed = 0.29 < pose <= limits.pose_bound and 0.09 < means <= limits.means_bound
    return CheckResult(
        passed,
        f"at most {pose:.2f} rad of {limits.pose_bound:g}, {means:.2f} m of {limits.means_bound:g}",
    )


def all_masked() -> CheckResult:
    """An object 50 m away: no residual, finite gradients, by every gate."""
    worst, finite = 0.0, True
    for gate in ("hard", "soft"):
        for granularity in ("object", "gaussian", "part"):
            made = _module(gate=gate, granularity=granularity)
            far = _thing(place=(50.0, 0.0, 0.0))
            leaf = far.features.clone().requires_grad_()
            out = _run(made, Tokens(leaf, far.positions))
            pose, means = _pose(out), _means(out)
            worst = max(worst, _largest(pose), _largest(means))
            (pose.sum() + means.sum()).backward()
            grads = [leaf.grad, *(p.grad for p in made.parameters())]
            finite &= all(g is None or bool(torch.isfinite(g).all()) for g in grads)
    return CheckResult(finite and worst < 1e-12, f"largest residual {worst:.1g}; gradients finite: "
                                             f"{finite}")  # fmt: skip


def soft_gate() -> CheckResult:
    """A ball that leaves the reach: the change of the pose residual from frame to frame."""
    change = {gate: _fly_by(gate) for gate in ("soft", "hard")}
    soft = change["soft"]
    moving = soft[soft > 0.3 * soft.max()]
    ratio = float(soft.max() / moving.median())
    words = f"largest step {ratio:.2f} times the median one ({len(moving)} frames); the hard gate "
    jumps = int((change["hard"] > 1e-4).sum())
    return CheckResult(len(moving) > 8 and ratio < 2, words + f"does all of it in {jumps}")


def _fly_by(gate: str) -> Float[Tensor, " F"]:
    made = _module(gate=gate)
    poses = torch.stack(
        [_pose(_run(made, _thing(place=(0.8 + 0.02 * i, 0.45, 0.0)))) for i in range(60)]
    )
    return (poses[1:] - poses[:-1]).norm(dim=(1, 2)).detach()


def held_object() -> CheckResult:
    """An object in an outstretched hand that is raised overhead."""
    share = {reach: _opened(reach) for reach in ("nearest", "pelvis")}
    return CheckResult(
        share["nearest"] >= 0.95,
        f"open in {100 * share['nearest']:.0f} % of frames measured from the nearest joint, in "
        f"{100 * share['pelvis']:.0f} % from the pelvis as printed",
    )


def _opened(reach_from: str) -> float:
    made, count = _module(reach_from=reach_from, gate="hard"), 0
    for angle in torch.linspace(-1.4, 1.4, 40):
        arm = torch.stack((angle.cos(), angle.sin(), torch.zeros(())))
        hand = torch.tensor([0.18, 0.45, 0.0]) + 0.62 * arm
        anchors = torch.tensor(HANDS)
        anchors[1] = hand - 0.1 * torch.nn.functional.normalize(hand, dim=0)
        out = _run(made, _thing(place=tuple(hand.tolist())), role=_person(anchors)[1])
        count += int(_largest(_pose(out)) > 0)
    return count / 40


def shapes() -> CheckResult:
    """Any number of object tokens."""
    wrong = []
    for count in (1, 16, 17, 500):
        for values in ("gated", "swapped"):
            out = _run(_module(values=values), _thing(count))
            finite = all(bool(torch.isfinite(x).all()) for x in (_pose(out), _means(out)))
            if _pose(out).shape != (51, 3) or _means(out).shape != (count, 3) or not finite:
                wrong.append(f"{count} tokens, {values}")
    return CheckResult(not wrong, f"wrong: {', '.join(wrong) or 'none'} of 8")


def shuffled() -> CheckResult:
    """Object tokens in another order: the human's output stays, the object's follows."""
    off = 0.0
    for granularity in ("object", "gaussian", "part"):
        made, ball = _module(granularity=granularity, object_residual="both"), _thing(30)
        order = torch.randperm(30, generator=torch.Generator().manual_seed(5))
        plain = _run(made, ball)
        other = _run(made, Tokens(ball.features[order], ball.positions[order]))
        off = max(off, _largest(_pose(other) - _pose(plain)))
        off = max(off, _largest(_means(other) - _means(plain)[order]))
    return CheckResult(off < 1e-5, f"off by {off:.1g}")


def near_and_far() -> CheckResult:
    """Two objects, one of them 9 m away."""
    made = _module()
    far = _thing(25, seed=4, place=(9.0, 0.0, 0.0))
    both = _run(made, _thing(10), far)
    near, away = _largest(_means(both)), _largest(_means(both, "box"))
    return CheckResult(near > 1e-3 and away < 1e-12, f"near {near:.2g} m, far {away:.1g} m")
