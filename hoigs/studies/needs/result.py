"""Settings and results of a search: plain values, which reports are made from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch

from hoigs.core.interfaces.deformation import DeformationModel, has_knots
from hoigs.core.maths.splines import uniform_times
from hoigs.core.model.knot_refit import KnotTrial, ScreenMotion, as_movable, screen_of
from hoigs.core.parameters import on_host
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.studies.needs.search_space import (
    Candidate,
    Gain,
    Overrides,
    Score,
    SearchSpace,
    StepBudget,
)
from hoigs.studies.needs.trial import Trial

# A cheaper candidate instead of the chosen one, where a refit shows no visible difference.
#
# Scores on held-back frames cannot decide this: two trainings of one candidate lie tenths of a dB
# apart, and a spline with more knots than it needs is often a little ahead by chance.

UNSEEN = 0.5  # pixels: below the blur that every splat is drawn with (0.3 px^2, so sigma 0.55 px)


def cheapest_refit(
    candidates: Sequence[Candidate], place: int, trials: Mapping[str, Trial], clip: Clip
) -> int:
    """Index of the cheapest candidate that can reproduce the motion of the chosen one.

    The chosen one itself unless its deformations are splines over knots (`HasKnots`). Where it has
    to move unlike another (`Candidate.moves_unlike`) and does not, that one is compared further.
    Compared with it are candidates of the same class: with fewer uniform knots, refitted to its
    motion, or with other settings (a spline in place of a track), by the motion that they learned;
    and those that do not move, which take its Gaussians halfway through the clip.

    Args:
        candidates: that were tried, cheapest first. place: index of the chosen one. trials: by name
            of candidate.
    """
    chosen = trials[candidates[place].name]
    entities = [chosen.model.entity(name) for name in chosen.names]
    if not all(has_knots(entity.deformation) for entity in entities):
        return place
    screen = screen_of(clip)

    def holds(cheaper: int, how: Callable[..., bool]) -> bool:
        trial = trials[candidates[cheaper].name]
        others = [trial.model.entity(name).deformation for name in chosen.names]
        return all(
            how(entity.deformation, other, entity.canonical.detach(), screen)
            for entity, other in zip(entities, others, strict=True)
        )

    for cheaper in range(place):
        unlike = candidates[cheaper].name == candidates[place].moves_unlike
        if unlike and holds(cheaper, _moves_alike):
            return cheapest_refit(candidates, cheaper, trials, clip)
    return next((cheaper for cheaper in range(place) if holds(cheaper, _held)), place)


@torch.no_grad()
def track_moves(clip: Clip, names: Sequence[str]) -> bool:
    """Whether the clip's own track moves one of some objects visibly, by more than `UNSEEN`."""
    screen = screen_of(clip)
    for track in (clip.objects[name] for name in names if name in clip.objects):
        some = track.points[:: max(1, len(track.points) // 200)]
        points = some @ track.rotations.mT + track.translations[:, None]
        still = points[len(points) // 2].expand_as(points)
        if screen.deviation(screen.on_screen(points), screen.on_screen(still)) > UNSEEN:
            return True
    return False


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
        if not _same_but_knots(curve, cheaper):
            return _moves_alike(curve, cheaper, canonical, screen)
        count = len(cheaper.knots)
        if cheaper.knots.movable or count >= len(curve.knots):
            return False
        with as_movable(curve), KnotTrial(curve) as trial:
            trial.place(uniform_times(count), screen.sample_times())
            return screen.deviation(before, screen.paths(curve, canonical)) <= UNSEEN


@torch.no_grad()
def _moves_alike(curve: object, other: object, canonical: Gaussians, screen: ScreenMotion) -> bool:
    """Whether two motions with knots, as they were learned, are within `UNSEEN` pixels."""
    if not (has_knots(curve) and has_knots(other)):
        return False
    canonical = canonical.to("cpu")
    with on_host(curve), on_host(other):
        paths = [screen.paths(model, canonical) for model in (curve, other)]
    return screen.deviation(*paths) <= UNSEEN


def _same_but_knots(one: object, other: object) -> bool:
    """Whether two models of a class have the same settings, knots apart."""
    configs = (getattr(model, "config", None) for model in (one, other))
    kept = [x and x.model_dump(exclude={"keyframes", "keyframe_step", "adaptive"}) for x in configs]
    return kept[0] == kept[1]


TOTAL = 2.5  # full trainings that search, final training and pruning may cost together
QUICK = 1.8  # where the smallest model is not asked for
QUICK_STEPS = 840  # that a search costs there at most: of 1,200 steps it was measured with
FINAL, AFTER = 1.0, 0.1  # of these, for the final training and for pruning
SETTLES = "train.rates.settle"
SETTLE = 0.1  # of trials, answer and tuning: with constant rates the end of a training is noisy


@dataclass(frozen=True)
class Settings:
    """How to search.

    Attributes:
        least: dB of gain that are ignored (`search_space.near_best`).
        share, frames: share of the training frames that is held back, and the least number.
        budget: full trainings that everything may cost, including the final training.
        search_steps: of the full spec, that the search costs at most; None has no such bound.
        smallest: whether spaces that are for the smallest model only are searched.
    """

    least: float = 0.1
    share: float = 0.05
    frames: int = 3
    budget: float = TOTAL
    search_steps: int | None = None
    smallest: bool = True


@dataclass(frozen=True)
class Step:
    """Result of one candidate.

    Attributes:
        score: at `steps`, the last at which the chosen candidate was scored too. over_chosen: gain
            over the chosen candidate there. useless: what the best one gains over this one where
            this one is the truth; None where that was not measured. problem: why it could not be
            built.
    """

    candidate: Candidate
    steps: int = 0
    score: Score | None = None
    over_chosen: Gain | None = None
    useless: Gain | None = None
    seconds: float = 0.0
    problem: str = ""


@dataclass(frozen=True)
class Answer:
    """Result of one search space for one block of the spec.

    Attributes:
        block: key below `model`, or "" of a pair. chosen: None where nothing changes.
        skipped: why nothing was tried. overrides, afterwards: of the chosen candidate.
        refitted: candidate that scored best, whose motion the chosen one holds (`refit`).
    """

    space: SearchSpace
    block: str
    chosen: Candidate | None
    steps: tuple[Step, ...] = ()
    skipped: str = ""
    overrides: Overrides = field(default_factory=dict)
    refitted: str = ""
    afterwards: Overrides = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The search space, and the block if it has another name: "human planes of dancer"."""
        name = self.space.name
        return name if self.block in ("", name) else f"{name} of {self.block}"

    def step(self, candidate: Candidate) -> Step:
        return next(s for s in self.steps if s.candidate is candidate)


@dataclass(frozen=True)
class Needs:
    """Result of a search.

    Attributes:
        start: the base spec with the given settings. overrides: chosen for it. spec: with both.
        frames: positions that were held back.
        full: steps of a full training. budget: cost of the search, in its steps.
        seconds: of the search. full_seconds: of a full training, at the measured pace.
    """

    clip: str
    base: str
    start: Spec
    spec: Spec
    overrides: Overrides
    answers: tuple[Answer, ...]
    settings: Settings
    frames: tuple[int, ...]
    full: int
    budget: StepBudget
    seconds: float
    full_seconds: float


def summary_line(answer: Answer) -> str:
    """An answer in one line: "object: rigid, 3 knots, because …"."""
    name = answer.title
    if answer.chosen is None:
        return f"{name}: unchanged, because {answer.skipped}"
    if answer.skipped:
        return f"{name}: {answer.chosen.name}, because {answer.skipped}"
    reasons = [answer.chosen.why]
    if answer.refitted:
        reasons.append(f"the motion of {answer.refitted} fits it within {UNSEEN:g} pixel")
    candidates = list(answer.space.candidates)
    place = candidates.index(answer.chosen)
    cheaper = [s for s in answer.steps[:place] if s.over_chosen is not None]
    dearer = [s for s in answer.steps[place + 1 :] if s.over_chosen is not None]
    if cheaper:
        best = max(cheaper, key=lambda s: s.over_chosen.mean if s.over_chosen else 0.0)
        reasons.append(f"{best.candidate.name} is {best.over_chosen} from it")
    if dearer:
        best = max(dearer, key=lambda s: s.over_chosen.mean if s.over_chosen else 0.0)
        reasons.append(f"{best.candidate.name} would give {best.over_chosen}")
    return f"{name}: {answer.chosen.name}, because {'; '.join(reasons)}"
