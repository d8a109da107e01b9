"""F02 to F09, F45, F46: splines, keyframes and turns, straight from their own functions."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core import spline
from hoigs.core.entity import Entity
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.core.rotation import (
    axis_angle_to_matrices,
    axis_angle_to_quats,
    exp_se3,
    quats_to_matrices,
    slerp,
)
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.studies.stress.finding import Finding

PERIOD = 6  # frames of the fast motion of F02


def sparse_knots() -> Finding:
    """A sine of 6 frames through knots every 4, 2 and 1 frames, against |f''''| h^4 / 384."""
    frames = 49
    phase = 2 * math.pi / PERIOD * torch.arange(frames, dtype=torch.float64)
    wave = phase.sin()[:, None]
    errors, within = [], True
    for step in (4, 2, 1):
        knots, tangents = spline.fit(
            wave, spline.keyframe_count(frames, step), free_tangents=True, smoothness=1e-9
        )
        times = torch.linspace(0, 1, frames, dtype=torch.float64).tolist()
        fitted = [spline.cubic_hermite(knots[None], tangents[None], t)[0, 0] for t in times]
        errors.append(float((torch.stack(fitted) - wave[:, 0]).abs().max()))
        within &= errors[-1] <= (2 * math.pi / PERIOD * step) ** 4 / 384
    words = ", ".join(f"{e:.2g} every {s}" for e, s in zip(errors, (4, 2, 1), strict=True))
    return Finding(within and errors[-1] < 0.01, f"largest error of an amplitude of 1: {words}")


def slerp_signs() -> Finding:
    """A steady turn whose every other key is negated."""
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
    return Finding(worst < 1e-5, f"rotations differ by {worst:.1g}")


def slerp_ends() -> Finding:
    """Equal, opposite and half-turn keys: values and gradients."""
    finite, unit = True, 0.0
    for other in ([1.0, 0, 0, 0], [-1.0, 0, 0, 0], [0.0, 0, 0, 1.0], [1e-8, 1.0, 0, 0]):
        a = torch.tensor([1.0, 0, 0, 0], requires_grad=True)
        b = torch.tensor(other, requires_grad=True)
        out = slerp(a, b, 0.4)
        out.sum().backward()
        assert a.grad is not None and b.grad is not None
        finite &= all(bool(torch.isfinite(x).all()) for x in (out, a.grad, b.grad))
        unit = max(unit, abs(float(out.detach().norm()) - 1))
    return Finding(finite and unit < 1e-5, f"finite: {finite}; off unit length by {unit:.1g}")


def bar_keeps_its_length() -> Finding:
    """A bar that turns by 120 degrees between knots: one rigid motion against free Gaussians."""
    bar = torch.tensor([[-0.5, 0, 0], [0.0, 0, 0], [0.5, 0, 0]])
    turns = torch.zeros(4, 3)
    turns[:, 2] = math.radians(119) * torch.arange(4)  # the shorter way is the same way
    rest = Gaussians.from_points(bar, scales=0.1)
    rigid = Entity(rest, RigidSpline(4, rotation="slerp"))
    free = Entity(rest, CubicHermite(4, tangents="finite-difference"))
    with torch.no_grad():
        rigid.deformation.get_parameter("keyframe_quats").copy_(axis_angle_to_quats(turns))
        means = torch.einsum("kij,nj->nki", axis_angle_to_matrices(turns), bar)
        free.deformation.get_parameter("keyframe_means").copy_(means)
    shrink = {name: _shrink(entity) for name, entity in (("rigid", rigid), ("free", free))}
    return Finding(
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


def last_frame() -> Finding:
    """The last frame reads the last knot, whatever the lengths."""
    worst, count = 0.0, 0
    for frames in (2, 3, 5, 300):
        for step in (1, 4, 7):
            knots = torch.randn(3, spline.keyframe_count(frames, step), 3)
            tangents = torch.randn_like(knots)
            for values in (
                spline.cubic_hermite(knots, tangents, 1.0),
                spline.catmull_rom(knots, 1.0),
                spline.linear(knots, 1.0),
            ):
                worst, count = max(worst, float((values - knots[:, -1]).abs().max())), count + 1
    return Finding(worst < 1e-5, f"{count} splines, off the last knot by {worst:.1g}")


def turns_near_zero() -> Finding:
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
    return Finding(finite and off < 1e-6, f"gradients finite: {finite}; off I + [w] by {off:.1g}")


def _cross(w: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def beyond_one() -> Finding:
    """Keys whose scalar product rounds to more than 1."""
    generator = torch.Generator().manual_seed(0)
    keys = torch.nn.functional.normalize(torch.randn(4000, 4, generator=generator), dim=-1)
    keys = (keys * (1 + 1e-7)).requires_grad_()
    over = int(((keys * keys).sum(-1) > 1).sum())
    out = slerp(keys, keys.detach().clone(), 0.3)
    out.sum().backward()
    assert keys.grad is not None
    finite = bool(torch.isfinite(out).all() and torch.isfinite(keys.grad).all())
    return Finding(finite and over > 0, f"{over} products above 1, finite: {finite}")
