"""Fewer spline knots: refit with one fewer, as long as nothing moves by a pixel (SplineGS; G.3).

SplineGS (Park et al. 2025) takes the mean over all frames; here it is the worst frame, so that a
long quiet clip does not hide one jerk (as `KnotSchedule` has it).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TypeGuard

import torch
from torch import Tensor

from hoigs.core.clip import Clip
from hoigs.core.context import BuildContext
from hoigs.core.gaussians import Gaussians
from hoigs.plugins.deformation.knot_schedule import (
    AdaptiveKnotsConfig,
    KnotSchedule,
    KnotTrial,
    MovingCurve,
)
from hoigs.plugins.deformation.knots import Knots
from hoigs.plugins.deformation.on_host import on_host
from hoigs.plugins.features.spline_motion import SplineMotionFeatures

FEWEST = 2


class Knotted(MovingCurve, Protocol):
    """A deformation with knots, uniform ones or movable ones."""

    keyframes: int


def is_knotted(deformation: object) -> TypeGuard[Knotted]:
    """Whether `fewer_uniform` and `remove_movable` can work on it."""
    return all(
        hasattr(deformation, name)
        for name in ("knots", "knot_axes", "keyframes", "traced", "resampled")
    )


def measure(clip: Clip, pixels: float) -> KnotSchedule:
    """The test of one pixel against the cameras of a clip, one a frame; it is done on the CPU."""
    config = AdaptiveKnotsConfig(pixels=pixels)
    return KnotSchedule.from_context(config, BuildContext(clip=clip))


@contextmanager
def as_movable(curve: Knotted, rest: Gaussians) -> Iterator[None]:
    """Uniform knots that can be tried elsewhere, where they are; movable ones are left, as tangents
    are per interval of the knots that they began with."""
    own = curve.knots
    if not own.movable:
        curve.knots = Knots(len(own), movable=True).to(rest.means.device)
    try:
        yield
    finally:
        curve.knots = own


@torch.no_grad()
def remove_movable(curve: Knotted, rest: Gaussians, schedule: KnotSchedule) -> int:
    """Take out knots of an adaptive spline; how many went."""
    before = len(curve.knots)
    with on_host(curve):
        schedule.remove(curve, rest.to("cpu"))
    return before - len(curve.knots)


@torch.no_grad()
def fewer_uniform(
    curve: Knotted, rest: Gaussians, schedule: KnotSchedule
) -> tuple[int, dict[str, Tensor]]:
    """The fewest uniform knots whose refitted motion stays within `pixels` of the present one, and
    the parameters at them, on the CPU; tangents are per interval of the new knots.

    Each count is refitted to the motion as it is now, one fewer at a time, until one fails.
    """
    count = len(curve.knots)
    rest = rest.to("cpu")
    with on_host(curve), as_movable(curve, rest):
        best, values = count, _values(curve)
        still, fit = schedule.screen(curve, rest), schedule.sample_times()
        for fewer in range(count - 1, FEWEST - 1, -1):
            with KnotTrial(curve) as trial:
                trial.place([k / (fewer - 1) for k in range(fewer)], fit)
                if schedule.deviation(still, schedule.screen(curve, rest)) > schedule.config.pixels:
                    break
                best = fewer
                values = _values(curve)
    if best == count:
        return count, values
    longer = (count - 1) / (best - 1)  # tangents are displacements per interval, which is longer
    return best, {n: v * longer if "tangents" in n else v for n, v in values.items()}


def _values(curve: Knotted) -> dict[str, Tensor]:
    """What stands at the knots now."""
    return {name: curve.get_parameter(name).detach().clone() for name in curve.knot_axes}


def slowed(features: SplineMotionFeatures, count: int, fewer: int) -> Tensor:
    """The first weights of the token's network, for velocities per interval of fewer knots."""
    weight = features.mlp.get_parameter("0.weight").detach().clone()
    weight[:, :3] *= (fewer - 1) / (count - 1)
    return weight
