"""A cheaper candidate instead of the chosen one, where a refit shows no visible difference.

Scores on held-back frames cannot decide this: two trainings of one candidate lie tenths of a dB
apart, and a spline with more knots than it needs is often a little ahead by chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from hoigs.core.interfaces.deformation import DeformationModel, has_knots
from hoigs.core.maths.knots import uniform_times
from hoigs.core.model.knot_refit import KnotTrial, ScreenMotion, as_movable, screen_of
from hoigs.core.model.on_host import on_host
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.studies.needs.search_space import Candidate
from hoigs.studies.needs.trial import Trial

UNSEEN = 0.5  # pixels: below the blur that every splat is drawn with (0.3 px^2, so sigma 0.55 px)


def cheapest_refit(
    candidates: Sequence[Candidate], place: int, trials: Mapping[str, Trial], clip: Clip
) -> int:
    """Index of the cheapest candidate that can reproduce the motion of the chosen one.

    The chosen one itself unless its deformations are splines over knots (`HasKnots`). Compared with
    it are candidates of the same class with fewer uniform knots, refitted to its motion, and those
    that do not move, which take its Gaussians halfway through the clip.

    Args:
        candidates: that were tried, cheapest first. place: index of the chosen one. trials: by name
            of candidate.
    """
    chosen = trials[candidates[place].name]
    entities = [chosen.model.entity(name) for name in chosen.names]
    if not all(has_knots(entity.deformation) for entity in entities):
        return place
    screen = screen_of(clip)
    for cheaper in range(place):
        trial = trials[candidates[cheaper].name]
        others = [trial.model.entity(name).deformation for name in chosen.names]
        if all(
            _held(entity.deformation, other, entity.canonical.detach(), screen)
            for entity, other in zip(entities, others, strict=True)
        ):
            return cheaper
    return place


@torch.no_grad()
def _held(
    curve: DeformationModel, cheaper: DeformationModel, canonical: Gaussians, screen: ScreenMotion
) -> bool:
    """Whether `cheaper` reproduces the motion of `curve` to within `UNSEEN` pixels."""
    assert has_knots(curve)
    canonical = canonical.to("cpu")
    with on_host(curve):
        before = screen.paths(curve, canonical)
        if not cheaper.moves:
            middle = curve.traced(canonical, [0.5] * len(before))
            return screen.deviation(before, screen.on_screen(middle)) <= UNSEEN
        if type(cheaper) is not type(curve) or not has_knots(cheaper):
            return False
        count = len(cheaper.knots)
        if cheaper.knots.movable or count >= len(curve.knots):
            return False
        with as_movable(curve), KnotTrial(curve) as trial:
            trial.place(uniform_times(count), screen.sample_times())
            return screen.deviation(before, screen.paths(curve, canonical)) <= UNSEEN
