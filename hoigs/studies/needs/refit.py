"""A rigid spline that fewer knots follow as closely as anybody could see needs no more of them.

Held-back frames alone cannot say so: two trainings of one rung lie tenths of a dB apart, and a
spline with knots to spare is a little ahead by chance as often as not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from hoigs.core.clip import Clip
from hoigs.core.gaussians import Gaussians
from hoigs.plugins.deformation.knot_schedule import KnotSchedule, KnotTrial
from hoigs.plugins.deformation.on_host import on_host
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.plugins.deformation.static import Static
from hoigs.studies.needs.prune_knots import Knotted, as_movable, measure
from hoigs.studies.needs.rungs import Rung
from hoigs.studies.needs.trial import Trial

UNSEEN = 0.5  # pixels: below the blur that every splat is drawn with (0.3 px^2, so sigma 0.55 px)


def cheapest_refit(
    rungs: Sequence[Rung], place: int, trials: Mapping[str, Trial], clip: Clip
) -> int:
    """Place of the cheapest rung whose knots hold the motion of the chosen one.

    Asked where that is a `deformation:rigid-spline`. Cheaper rungs that can hold it are others of
    fewer uniform knots, and `deformation:static`: as it stands halfway through the clip.

    Args:
        rungs: that were tried, cheapest first. place: of the chosen one. trials: by name of rung.
    """
    chosen = trials[rungs[place].name]
    entities = [chosen.model.entity(name) for name in chosen.names]
    curves = [e.deformation for e in entities if type(e.deformation) is RigidSpline]
    if len(curves) < len(entities):
        return place
    schedule = measure(clip, UNSEEN)
    for cheaper in range(place):
        trial = trials[rungs[cheaper].name]
        counts = [_uniform_knots(trial.model.entity(name).deformation) for name in chosen.names]
        if all(
            count is not None and _held(curve, entity.rest.detach(), count, schedule)
            for curve, entity, count in zip(curves, entities, counts, strict=True)
        ):
            return cheaper
    return place


def _uniform_knots(deformation: object) -> int | None:
    """Of a rigid spline; 1 of what stands still; None of what can hold no motion of another's."""
    if type(deformation) is RigidSpline:
        return None if deformation.knots.movable else len(deformation.knots)
    return 1 if type(deformation) is Static else None


@torch.no_grad()
def _held(curve: Knotted, rest: Gaussians, count: int, schedule: KnotSchedule) -> bool:
    """Whether nothing moves by `UNSEEN` pixels when `count` uniform knots have to do."""
    rest = rest.to("cpu")
    with on_host(curve):
        still = schedule.screen(curve, rest)
        if count == 1:
            middle = curve.traced(rest, [0.5] * len(schedule.frame_times))
            return schedule.deviation(still, schedule.on_screen(middle)) <= UNSEEN
        if count >= len(curve.knots):
            return False
        with as_movable(curve, rest), KnotTrial(curve) as trial:
            trial.place([k / (count - 1) for k in range(count)], schedule.sample_times())
            return schedule.deviation(still, schedule.screen(curve, rest)) <= UNSEEN
