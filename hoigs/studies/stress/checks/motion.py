"""F02, F04 to F07, F45, F46: direct checks of splines, keyframes and rotations."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths import splines
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    axis_angle_to_quats,
    exp_se3,
    quats_to_matrices,
    slerp,
)
from hoigs.core.maths.splines import Knots, uniform_times
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.studies.stress.case import CheckResult
from hoigs.studies.stress.checks.toy import component

PERIOD = 6  # frames of the fast motion of F02


def sparse_knots() -> CheckResult:
    """A sine of 6 frames through knots every 4, 2 and 1 frames, against |f''''| h^4 / 384."""
    frames = 49
    phase = 2 * math.pi / PERIOD * torch.arange(frames, dtype=torch.float64)
    wave = phase.sin()[:, None]
    errors, within = [], True
    times = uniform_times(frames)
    for step in (4, 2, 1):
        knots = Knots(splines.keyframe_count(frames, step))
        values, tangents = knots.fit(wave, times, free_tangents=True, smoothness=1e-9)
        fitted = splines.cubic_hermite(values, tangents, knots.at_times(times, values))
        errors.append(float((fitted - wave).abs().max()))
        within &= errors[-1] <= (2 * math.pi / PERIOD * step) ** 4 / 384
    words = ", ".join(f"{e:.2g} every {s}" for e, s in zip(errors, (4, 2, 1), strict=True))
    return CheckResult(within and errors[-1] < 0.01, f"largest error of an amplitude of 1: {words}")


def slerp_signs() -> CheckResult:
    """A steady rotation whose every other key quaternion is negated."""
    turn = torch.zeros(9, 3, dtype=torch.float64)
    turn[:, 1] = 0.4 * torch.arange(9)
    keys = axis_angle_to_quats(turn)
    signs = torch.ones(9, 1, dtype=torch.float64)
    signs[1::2] = -1
    worst = 0.0
    for r in (0.0, 0.25, 0.5, 0.9, 1.0):
        plain = quats_to_matrices(slerp(keys[:-1], keys[1:], r))
        flipped = quats_to_matrices(slerp((signs * keys)[:-1], (signs * keys)[1:], r))
        worst = max(worst, float((plain - flipped).abs().max()))
    return CheckResult(worst < 1e-5, f"rotations differ by {worst:.1g}")


def slerp_ends() -> CheckResult:
    """Key quaternions that are equal, opposite or half a turn apart: values and gradients."""
    finite, unit = True, 0.0
    for other in ([1.0, 0, 0, 0], [-1.0, 0, 0, 0], [0.0, 0, 0, 1.0], [1e-8, 1.0, 0, 0]):
        a = torch.tensor([1.0, 0, 0, 0], requires_grad=True)
        b = torch.tensor(other, requires_grad=True)
        out = slerp(a, b, 0.4)
        out.sum().backward()
        assert a.grad is not None and b.grad is not None
        finite &= all(bool(torch.isfinite(x).all()) for x in (out, a.grad, b.grad))
        unit = max(unit, abs(float(out.detach().norm()) - 1))
    return CheckResult(finite and unit < 1e-5, f"finite: {finite}; off unit length by {unit:.1g}")


def bar_keeps_its_length() -> CheckResult:
    """A bar that rotates by 120 degrees between knots: one rigid motion against free Gaussians."""
    bar = torch.tensor([[-0.5, 0, 0], [0.0, 0, 0], [0.5, 0, 0]])
    turns = torch.zeros(4, 3)
    turns[:, 2] = math.radians(119) * torch.arange(4)  # the shorter way is the same way
    canonical = Gaussians.from_points(bar, scales=0.1)
    rigid = Entity(canonical, component("deformation:rigid-spline", keyframes=4, rotation="slerp"))
    free = Entity(
        canonical, component("deformation:chs", keyframes=4, tangents="finite-difference")
    )
    with torch.no_grad():
        rigid.deformation.get_parameter("keyframe_quats").copy_(axis_angle_to_quats(turns))
        means = torch.einsum("kij,nj->nki", axis_angle_to_matrices(turns), bar)
        free.deformation.get_parameter("keyframe_means").copy_(means)
    shrink = {name: _shrink(entity) for name, entity in (("rigid", rigid), ("free", free))}
    return CheckResult(
        shrink["rigid"] < 0.02,
        f"length varies by {100 * shrink['rigid']:.2g} % with one rigid motion, by "
        f"{100 * shrink['free']:.0f} % with knots of each Gaussian's own",
    )


@torch.no_grad()
def _shrink(entity: Entity) -> float:
    """Largest relative change of the distance between the ends, over time."""
    lengths = []
    for time in torch.linspace(0, 1, 61).tolist():
        means = entity(Moment(time)).means
        lengths.append(float((means[0] - means[-1]).norm()))
    return max(abs(length / lengths[0] - 1) for length in lengths)


def last_frame() -> CheckResult:
    """The last frame has the last knot's value, for any number of frames and knots."""
    worst, count = 0.0, 0
    for frames in (2, 3, 5, 300):
        for step in (1, 4, 7):
            knots = Knots(splines.keyframe_count(frames, step))
            values, tangents = torch.randn(2, 3, len(knots), 3)
            for found in (
                knots.hermite(values, tangents, 1.0),
                knots.catmull_rom(values, 1.0),
                knots.linear(values, 1.0),
            ):
                worst, count = max(worst, float((found - values[:, -1]).abs().max())), count + 1
    return CheckResult(worst < 1e-5, f"{count} splines, off the last knot by {worst:.1g}")


def turns_near_zero() -> CheckResult:
    """The exponential maps at and near w = 0: values and gradients."""
    finite, off = True, 0.0
    for size in (0.0, 1e-20, 1e-8, 1e-4):
        w = torch.full((2, 3), size, requires_grad=True)
        shift = torch.ones(2, 3, requires_grad=True)
        quats, moved = exp_se3(w, shift)
        matrices = axis_angle_to_matrices(w)
        (quats.sum() + moved.sum() + matrices.sum()).backward()
        assert w.grad is not None and shift.grad is not None
        finite &= bool(torch.isfinite(w.grad).all() and torch.isfinite(shift.grad).all())
        off = max(off, float((matrices.detach() - torch.eye(3) - _cross(w.detach())).abs().max()))
    return CheckResult(
        finite and off < 1e-6, f"gradients finite: {finite}; off I + [w] by {off:.1g}"
    )


def _cross(w: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def beyond_one() -> CheckResult:
    """Keys whose scalar product rounds to more than 1."""
    generator = torch.Generator().manual_seed(0)
    keys = torch.nn.functional.normalize(torch.randn(4000, 4, generator=generator), dim=-1)
    keys = (keys * (1 + 1e-7)).requires_grad_()
    over = int(((keys * keys).sum(-1) > 1).sum())
    out = slerp(keys, keys.detach().clone(), 0.3)
    out.sum().backward()
    assert keys.grad is not None
    finite = bool(torch.isfinite(out).all() and torch.isfinite(keys.grad).all())
    return CheckResult(finite and over > 0, f"{over} products above 1, finite: {finite}")
