"""A rigid spline that fewer knots follow as closely as anybody could see needs no more of them.

Held-back frames alone cannot say so: two trainings of one rung lie tenths of a dB apart, and a
spline with knots to spare is a little ahead by chance as often as not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from hoigs.core.clip import Clip
from hoigs.core.gaussians import Gaussians
from hoigs.plugins.deformation.knot_schedule import KnotSchedule, KnotTrial
from hoigs.plugins.deformation.knots import Knots
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.plugins.deformation.static import Static
from hoigs.studies.needs.prune_knots import measure
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
    curves = [entity.deformation for entity in entities]
    if not all(type(curve) is RigidSpline for curve in curves):
        return place
    schedule = measure(clip, UNSEEN).to(chosen.model.device)
    for cheaper in range(place):
        trial = trials[rungs[cheaper].name]
        counts = [_knots(trial.model.entity(name).deformation) for name in chosen.names]
        if all(
            count is not None and _held(curve, entity.rest.detach(), count, schedule)
            for curve, entity, count in zip(curves, entities, counts, strict=True)
        ):
            return cheaper
    return place


def _knots(deformation: object) -> int | None:
    """How many places a deformation can take on its way; None where it is no rigid spline."""
    if type(deformation) is RigidSpline:
        return None if deformation.knots.movable else len(deformation.knots)
    return 1 if type(deformation) is Static else None


@torch.no_grad()
def _held(curve: Any, rest: Gaussians, count: int, schedule: KnotSchedule) -> bool:
    """Whether nothing moves by `UNSEEN` pixels when `count` uniform knots have to do."""
    still = schedule.screen(curve, rest)
    if count == 1:
        middle = curve.traced(rest, [0.5] * len(schedule.frame_times))
        return schedule.deviation(still, schedule.on_screen(middle)) <= UNSEEN
    own = curve.knots
    if count >= len(own):
        return False
    curve.knots = Knots(len(own), movable=True).to(rest.means.device)
    curve.knots.place(own.tolist())
    try:
        with KnotTrial(curve) as trial:
            trial.place([k / (count - 1) for k in range(count)], schedule.sample_times())
            return schedule.deviation(still, schedule.screen(curve, rest)) <= UNSEEN
    finally:
        curve.knots = own
