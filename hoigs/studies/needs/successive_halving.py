"""Successive halving under a budget (Jamieson & Talwalkar 2016, arXiv:1502.07943)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from hoigs.core.errors import HoigsError
from hoigs.studies.needs.criterion import Criterion, Score, choose, ranked

FINALISTS = 2  # more rounds would leave nothing to choose from
SCORING = 0.4  # of a step: one frame drawn once, without gradients
FEWEST = 8  # steps before the first score; earlier ones carry no information

Advance = Callable[[int, int], Score]  # index and step: train to that step, and score


class BudgetError(HoigsError):
    """A search would cost more than it may."""


@dataclass
class StepBudget:
    """The cost so far, in training steps of the full spec.

    Attributes:
        limit: the most that may be spent. entries: purpose and cost of each expense.
    """

    limit: float
    entries: list[tuple[str, float]] = field(default_factory=list)

    @property
    def spent(self) -> float:
        return sum(cost for _, cost in self.entries)

    @property
    def left(self) -> float:
        return self.limit - self.spent

    def spend(self, what: str, cost: float) -> None:
        """To be called before the work is done.

        Raises:
            BudgetError: the cost exceeds what is left.
        """
        if cost > self.left + 1e-6:
            raise BudgetError(
                f"{what} would cost {cost:.0f} steps, but {self.left:.0f} of {self.limit:.0f} are "
                "left"
            )
        self.entries.append((what, cost))


@dataclass(frozen=True)
class Plan:
    """Rounds of one search: how many candidates each trains, and to which step."""

    alive: tuple[int, ...]
    until: tuple[int, ...]

    @property
    def steps(self) -> int:
        return self.until[-1]


def rounds(count: int) -> tuple[int, ...]:
    """How many of `count` candidates each round trains: half, then half of these, down to two."""
    alive = [count]
    while alive[-1] > FINALISTS:
        alive.append(max(FINALISTS, -(-alive[-1] // 2)))
    return tuple(alive)


def plan(costs: Sequence[float], budget: float, frames: int, most: int) -> Plan:
    """The longest rounds, each twice as long as all before, that fit a budget whichever candidates
    remain.

    Args:
        costs: of a step of each candidate. budget: steps of the full spec.
        frames: scored each round. most: steps that no trial goes beyond.

    Raises:
        BudgetError: the shortest rounds exceed the budget.
    """
    alive = rounds(len(costs))
    dearest = sorted(costs, reverse=True)
    scoring = sum(SCORING * frames * sum(dearest[:n]) for n in alive)
    unit = sum(sum(dearest[:n]) * (1 if r == 0 else 2 ** (r - 1)) for r, n in enumerate(alive))
    first = int((budget - scoring) / unit + 1e-9)
    first = min(first, max(1, most // 2 ** (len(alive) - 1)))
    if first < FEWEST:
        wanted = scoring + FEWEST * unit
        raise BudgetError(
            f"{len(costs)} candidates need {wanted:.0f} steps at least, but get {budget:.0f}: "
            "give a training more steps (--set train.steps=…), or a search space fewer candidates"
        )
    return Plan(alive, tuple(first * 2**r for r in range(len(alive))))


@dataclass(frozen=True)
class Halving:
    """Result of a successive halving.

    Attributes:
        chosen: index of the candidate. scores: of each candidate, by step.
    """

    chosen: int
    scores: tuple[dict[int, Score], ...]

    def last_common(self, one: int, other: int) -> tuple[int, Score, Score]:
        """The last step at which both were scored, and their scores there."""
        step = max(self.scores[one].keys() & self.scores[other].keys())
        return step, self.scores[one][step], self.scores[other][step]


def successive_halving(
    plan: Plan,
    costs: Sequence[float],
    frames: int,
    advance: Advance,
    budget: StepBudget,
    *,
    what: str = "",
    criterion: Criterion = "one-se",
    least: float = 0.0,
    min_gain: float = 0.0,
) -> Halving:
    """Halve until two candidates are left, and choose between them.

    Args:
        plan: from `plan`. costs: of a step of each candidate, the cheapest first.
        frames: number of frames scored in each round. advance: trains and scores a candidate.
        budget: each training is entered before it runs, as `what`.

    Raises:
        BudgetError: the plan exceeds the budget; no training beyond it has run.
    """
    scores: list[dict[int, Score]] = [{} for _ in costs]
    alive, before = list(range(len(costs))), 0
    for count, until in zip(plan.alive, plan.until, strict=True):
        if len(alive) > count:
            order = ranked([scores[k][before] for k in alive], criterion, least, min_gain)
            alive = sorted(alive[place] for place in order[:count])
        for k in alive:
            budget.spend(f"{what}[{k}]", costs[k] * (until - before + SCORING * frames))
            scores[k][until] = advance(k, until)
        before = until
    chosen = alive[choose([scores[k][before] for k in alive], criterion, least, min_gain)]
    return Halving(chosen, tuple(scores))
