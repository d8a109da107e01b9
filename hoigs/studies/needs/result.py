"""Settings and results of a search: plain values, which reports are made from."""

from __future__ import annotations

from dataclasses import dataclass, field

from hoigs.core.spec.schema import Spec
from hoigs.studies.needs.criterion import Criterion, Gain, Score
from hoigs.studies.needs.refit import UNSEEN
from hoigs.studies.needs.search_space import Candidate, Overrides, SearchSpace
from hoigs.studies.needs.successive_halving import StepBudget

TOTAL = 2.5  # full trainings that search, final training and pruning may cost together
FINAL, AFTER = 1.0, 0.1  # of these, for the final training and for pruning
SETTLES = "train.rates.settle"
SETTLE = 0.1  # of trials, answer and tuning: with constant rates the end of a training is noisy


@dataclass(frozen=True)
class Settings:
    """How to search.

    Attributes:
        criterion: "one-se" or "bic". least: dB of gain that are ignored (`criterion.near_best`).
        share, frames: share of the training frames that is held back, and the least number.
        budget: full trainings that everything may cost, including the final training.
    """

    criterion: Criterion = "one-se"
    least: float = 0.1
    share: float = 0.05
    frames: int = 3
    budget: float = TOTAL


@dataclass(frozen=True)
class Step:
    """Result of one candidate.

    Attributes:
        score: at `steps`, the last at which the chosen candidate was scored too. over_chosen: gain
            over the chosen candidate there. problem: why it could not be built.
    """

    candidate: Candidate
    steps: int = 0
    score: Score | None = None
    over_chosen: Gain | None = None
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
