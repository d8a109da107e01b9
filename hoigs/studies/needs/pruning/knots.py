"""Fewer spline knots: refit with one fewer, as long as nothing moves by a pixel.

That is the criterion of SplineGS (Park et al. 2025), in the worst frame instead of the mean over
all frames, so that a long quiet clip does not hide one jerk.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.interfaces.deformation import HasKnots
from hoigs.core.maths.knots import uniform_times
from hoigs.core.model.knot_refit import (
    KnotTrial,
    ScreenMotion,
    as_movable,
    remove_knots,
)
from hoigs.core.model.on_host import on_host
from hoigs.core.values.gaussians import Gaussians

FEWEST_UNIFORM, FEWEST_MOVABLE = 2, 4


@torch.no_grad()
def remove_movable(
    curve: HasKnots, canonical: Gaussians, screen: ScreenMotion, pixels: float
) -> int:
    """Take knots out of an adaptive spline as long as nothing moves by more than `pixels`; returns
    how many."""
    before = len(curve.knots)
    with on_host(curve):
        near = canonical.to("cpu")
        remove_knots(curve, near, screen, pixels=pixels, minimum=FEWEST_MOVABLE)
    return before - len(curve.knots)


@torch.no_grad()
def fewer_uniform(
    curve: HasKnots, canonical: Gaussians, screen: ScreenMotion, pixels: float
) -> tuple[int, dict[str, Tensor]]:
    """The fewest uniform knots whose refitted motion stays within `pixels` of the present one, and
    the parameters at them, on the CPU; tangents are per interval of the new knots.

    Each count is refitted to the motion as it is now, one fewer at a time, until one fails.
    """
    count = len(curve.knots)
    canonical = canonical.to("cpu")
    with on_host(curve), as_movable(curve):
        best, values = count, _values(curve)
        before, fit = screen.paths(curve, canonical), screen.sample_times()
        for fewer in range(count - 1, FEWEST_UNIFORM - 1, -1):
            with KnotTrial(curve) as trial:
                trial.place(uniform_times(fewer), fit)
                if screen.deviation(before, screen.paths(curve, canonical)) > pixels:
                    break
                best, values = fewer, _values(curve)
    if best == count:
        return count, values
    longer = (count - 1) / (best - 1)  # tangents are displacements per interval, which is longer
    return best, {n: v * longer if "tangents" in n else v for n, v in values.items()}


def _values(curve: HasKnots) -> dict[str, Tensor]:
    """The parameters at the knots."""
    return {name: curve.get_parameter(name).detach().clone() for name in curve.knot_axes}
