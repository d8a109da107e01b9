"""Successive halving under a budget (Jamieson & Talwalkar 2016). Pure: trials are given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from hoigs.core.errors import HoigsError
from hoigs.studies.needs.criterion import Criterion, Score, choose, ranked

FINALISTS = 2  # more rounds would leave nothing to choose from
SCORING = 0.4  # of a step: one frame drawn once, without gradients
FEWEST = 8  # steps before the first look, below which scores say nothing

Advance = Callable[[int, int], Score]  # rung and step: train it on to that step, and score it


class BudgetError(HoigsError):
    """A search would cost more than it may."""


@dataclass
class Ledger:
    """What has been spent, in steps of the full spec.

    Attributes:
        limit: that may be spent. entries: what on, and how much.
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
            BudgetError: it would be more than is left.
        """
        if cost > self.left + 1e-6:
            raise BudgetError(
                f"{what} would cost {cost:.0f} steps, but {self.left:.0f} of {self.limit:.0f} are "
                "left"
            )
        self.entries.append((what, cost))


@dataclass(frozen=True)
class Plan:
    """Rounds of a ladder: how many rungs are trained, and to which step."""

    alive: tuple[int, ...]
    until: tuple[int, ...]

    @property
    def steps(self) -> int:
        return self.until[-1]


def rounds(count: int) -> tuple[int, ...]:
    """How many of `count` rungs each round trains: half, then half of these, down to two."""
    alive = [count]
    while alive[-1] > FINALISTS:
        alive.append(max(FINALISTS, -(-alive[-1] // 2)))
    return tuple(alive)


def plan(costs: Sequence[float], budget: float, frames: int, most: int) -> Plan:
    """The longest rounds, each twice as long as all before, that a budget pays for, whichever
    rungs stay.

    Args:
        costs: of a step of each rung. budget: steps of the full spec. frames: scored each round.
        most: steps that no trial goes beyond.

    Raises:
        BudgetError: not even the shortest rounds are paid for.
    """
    alive = rounds(len(costs))
    dearest = sorted(costs, reverse=True)
    looks = sum(SCORING * frames * sum(dearest[:n]) for n in alive)
    unit = sum(sum(dearest[:n]) * (1 if r == 0 else 2 ** (r - 1)) for r, n in enumerate(alive))
    first = int((budget - looks) / unit + 1e-9)
    first = min(first, max(1, most // 2 ** (len(alive) - 1)))
    if first < FEWEST:
        wanted = looks + FEWEST * unit
        raise BudgetError(
            f"{len(costs)} rungs need {wanted:.0f} steps at least, but get {budget:.0f}: "
            "give a training more steps (--set train.steps=…), or a ladder fewer rungs"
        )
    return Plan(alive, tuple(first * 2**r for r in range(len(alive))))


@dataclass(frozen=True)
class Climbed:
    """How halving went.

    Attributes:
        chosen: place of the rung. looks: of each rung, its score by step.
    """

    chosen: int
    looks: tuple[dict[int, Score], ...]

    def together(self, one: int, other: int) -> tuple[int, Score, Score]:
        """The last step at which both were looked at, and their scores there."""
        step = max(self.looks[one].keys() & self.looks[other].keys())
        return step, self.looks[one][step], self.looks[other][step]


def climb(
    plan: Plan,
    costs: Sequence[float],
    frames: int,
    advance: Advance,
    ledger: Ledger,
    *,
    what: str = "",
    criterion: Criterion = "one-se",
    least: float = 0.0,
    price: float = 0.0,
) -> Climbed:
    """Halve until two rungs are left, and choose between them.

    Args:
        plan: from `plan`. costs: of a step of each rung, cheapest rung first. frames: scored.
        advance: does the work. ledger: pays for it. what: in the ledger.

    Raises:
        BudgetError: the ledger has less than the plan costs; nothing beyond it has been done.
    """
    looks: list[dict[int, Score]] = [{} for _ in costs]
    alive, before = list(range(len(costs))), 0
    for count, until in zip(plan.alive, plan.until, strict=True):
        if len(alive) > count:
            order = ranked([looks[k][before] for k in alive], criterion, least, price)
            alive = sorted(alive[place] for place in order[:count])
        for k in alive:
            ledger.spend(f"{what}[{k}]", costs[k] * (until - before + SCORING * frames))
            looks[k][until] = advance(k, until)
        before = until
    chosen = alive[choose([looks[k][before] for k in alive], criterion, least, price)]
    return Climbed(chosen, tuple(looks))
