"""Search spaces: which changes to a spec are tried, as candidates from the cheapest; from YAML."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, stdev
from typing import Any, Literal

from pydantic import Field, ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.spec.loader import load_yaml
from hoigs.core.system.files import regular_file

BUILTIN = Path(__file__).with_name("search_spaces.yaml")
Kind = Literal["scene", "human", "object", "pair"]
Region = Literal["own", "background", "contact"]
Overrides = dict[str, Any]  # dotted key of a spec to its value


class Candidate(ComponentConfig):
    """One model to try: what it changes in the spec."""

    name: str
    """For tables."""
    overrides: Overrides = Field(default_factory=dict)
    """Dotted keys of a spec and their values. `{scene}`, `{human}` and `{object}` stand for the
    model blocks of that kind."""
    times: dict[str, float] = Field(default_factory=dict)
    """Dotted keys of numbers, and the factor that their present value is multiplied by. Keys that
    the spec does not have are ignored."""
    afterwards: Overrides = Field(default_factory=dict)
    """Overrides of the answer if this candidate is chosen, but of no trial: settings that need a
    longer training."""
    moves_unlike: str | None = None
    """A cheaper candidate of the space, which is taken in its place where the motions that both
    learned are within half a pixel: parts that do not move against each other are one."""
    cost: float = Field(default=1.0, gt=0)
    """Of one step of a trial, where a step of the full spec costs 1
    (`benchmarks/candidate_costs.py` measures it)."""
    why: str
    """What a scene has that needs this candidate, "because …"."""


class SearchSpace(ComponentConfig):
    """Candidates for one part of a spec."""

    name: str
    """For tables, and for `unless` of later search spaces."""
    kind: Kind
    """Trials model entities of this kind alone, each block of it in turn; a "pair" humans and
    objects."""
    region: Region = "own"
    """Where trials are scored. "own": visible pixels of the entity; "background": of no entity;
    "contact": of objects, and of humans within a twentieth of the image of them."""
    candidates: tuple[Candidate, ...] = Field(min_length=2)
    """Cheapest first."""
    share: float = Field(default=1.0, gt=0)
    """Of the search's budget, relative to the other search spaces."""
    least: float | None = Field(default=None, ge=0)
    """dB within which a cheaper candidate is taken; None takes `Settings.least`."""
    calibrated: bool = False
    """Whether the gain of a dearer candidate counts only beyond what it gains where the cheaper one
    is the truth (`calibration`)."""
    during: Overrides = Field(default_factory=dict)
    """Overrides of every trial, below those of its candidate."""
    unless: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    """Search space to candidates; this space is skipped where one of these was chosen."""
    else_cheapest: bool = False
    """A skipped space takes its first candidate; otherwise it changes nothing."""
    smallest_only: bool = False
    """Searched only for the smallest model: its trials are too short to show what a cheaper
    candidate loses in a whole training."""
    untried: str | None = None
    """Candidate that is taken where `smallest_only` keeps the space from being searched; None
    changes nothing."""
    turn_unknown: Candidate | None = None
    """What an object gets, untried, whose turn the clip does not know, but for the smallest model;
    None searches as for any other."""


class _File(ComponentConfig):
    search_spaces: tuple[SearchSpace, ...]


def load_search_spaces(path: Path | None = None) -> tuple[SearchSpace, ...]:
    """The search spaces of a file, by default those that come with hoigs.

    Raises:
        HoigsError: the file cannot be read or is invalid; each error on a line.
    """
    path = path or BUILTIN
    try:
        text = regular_file(path).read_text(encoding="utf-8")
    except OSError as error:
        raise HoigsError(
            f"{path}: the file of search spaces cannot be read: {error.strerror}"
        ) from error
    try:
        found = _File.model_validate(load_yaml(text, str(path)).data).search_spaces
    except ValidationError as error:
        lines = [f"{path} {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise HoigsError("\n".join(lines)) from error
    _check(found, path)
    return found


def _check(search_spaces: Sequence[SearchSpace], path: Path) -> None:
    def require(
        name: str | None, known: Iterable[str], key: str, what: str, where: str = ""
    ) -> None:
        if name is not None and name not in known:
            near = did_you_mean(name, known)
            raise HoigsError(f"{path} {key}: no {what} {name!r}{where}{near}")

    before: dict[str, list[str]] = {}
    for space in search_spaces:
        names = [candidate.name for candidate in space.candidates]
        require(space.untried, names, f"{space.name}.untried", "candidate")
        for place, candidate in enumerate(space.candidates):
            key = f"{space.name}.{candidate.name}.moves_unlike"
            require(candidate.moves_unlike, names[:place], key, "candidate", " above it")
        if len(set(names)) < len(names) or space.name in before:
            raise HoigsError(
                f"{path} {space.name}: search spaces and their candidates need unique names"
            )
        for other, candidates in space.unless.items():
            require(other, before, f"{space.name}.unless", "search space", " above it")
            for name in candidates:
                require(name, before[other], f"{space.name}.unless", "candidate", f" of {other}")
        before[space.name] = names


def expanded(overrides: Mapping[str, Any], blocks: Mapping[str, Sequence[str]]) -> Overrides:
    """Overrides with `{kind}` in their keys replaced by each block of that kind.

    Keys of a kind without a block are dropped.
    """
    found: Overrides = {}
    for key, value in overrides.items():
        keys = [key]
        for kind, names in blocks.items():
            mark = "{" + kind + "}"
            keys = [k.replace(mark, name) for k in keys for name in (names if mark in k else [""])]
        found |= dict.fromkeys(keys, value)
    return found


def multiplied(times: Mapping[str, float], tree: Mapping[str, Any]) -> Overrides:
    """`Candidate.times`, its blocks expanded, as overrides of a spec.

    Args:
        tree: the spec so far, as `Spec.model_dump` gives it.

    Raises:
        HoigsError: the value at a key is not a number.
    """
    found: Overrides = {}
    for key, factor in times.items():
        value: Any = tree
        for step in key.split("."):
            value = value.get(step) if isinstance(value, Mapping) else None
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise HoigsError(
                f"{key}: {value!r} cannot be multiplied by {factor:g}: it is not a number"
            )
        found[key] = max(1, round(value * factor)) if isinstance(value, int) else value * factor
    return found


def merged(below: Mapping[str, Any], over: Mapping[str, Any]) -> Overrides:
    """Two sets of overrides as one: a key of `over` replaces that key and the keys below it, and
    changes one setting of a block that was set as a whole.

    Raises:
        HoigsError: a key below one that has been set to null.
    """
    result = dict(below)
    for key, value in over.items():
        result = {k: v for k, v in result.items() if not k.startswith(f"{key}.")}
        holder = next((k for k in result if key.startswith(f"{k}.")), None)
        if holder is None:
            result[key] = value
            continue
        block = result[holder]
        if not isinstance(block, dict):
            raise HoigsError(f"{key}: {holder} has been set to {block!r}, which has no settings")
        result[holder] = _within(block, key.removeprefix(f"{holder}.").split("."), value)
    return result


def _within(block: dict[str, Any], place: Sequence[str], value: Any) -> dict[str, Any]:
    first, *rest = place
    inner = _within(dict(block.get(first) or {}), rest, value) if rest else value
    return {**block, first: inner}


def as_settings(overrides: Mapping[str, Any]) -> list[str]:
    """Overrides as `Spec.load` takes them: "a.b=value"."""
    return [f"{key}={json.dumps(value)}" for key, value in overrides.items()]


# Choosing a candidate: the cheapest within one standard error of the best.

PATIENCE = 1.5  # standard errors within which a candidate is kept before the last round


@dataclass(frozen=True)
class Score:
    """A candidate on the selection frames, in the region of its search space.

    Attributes:
        psnr: dB, one a frame; all candidates of a search space have the same frames.
        squares: summed squared error of a frame's region, mean over RGB. pixels: of the region.
        parameters: trained numbers of the trial's model.
    """

    psnr: tuple[float, ...]
    squares: tuple[float, ...]
    pixels: tuple[int, ...]
    parameters: int

    @property
    def mean(self) -> float:
        return mean(self.psnr)

    @property
    def mse(self) -> float:
        return sum(self.squares) / sum(self.pixels)


@dataclass(frozen=True)
class Gain:
    """Mean difference of two candidates over the same frames and its standard error, dB."""

    mean: float
    error: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} ± {self.error:.2f} dB"


def gain(of: Score, over: Score) -> Gain:
    """How much better `of` is than `over`.

    Raises:
        ValueError: fewer than two frames, or not the same number.
    """
    return mean_gain(differences(of, over))


def differences(of: Score, over: Score) -> list[float]:
    """How much better `of` is than `over` in each frame, dB.

    Raises:
        ValueError: as `gain`.
    """
    if len(of.psnr) != len(over.psnr) or len(of.psnr) < 2:
        raise ValueError(
            f"a paired standard error needs the same two or more frames: {len(of.psnr)} and "
            f"{len(over.psnr)}"
        )
    return [a - b for a, b in zip(of.psnr, over.psnr, strict=True)]


def mean_gain(differences: Sequence[float]) -> Gain:
    """Of differences in dB, one a frame."""
    return Gain(mean(differences), stdev(differences) / math.sqrt(len(differences)))


def near_best(scores: Sequence[Score], least: float = 0.0, errors: float = 1.0) -> list[bool]:
    """Whether each score is as good as the best: within `errors` standard errors of the paired
    difference, or within `least` dB."""
    best = max(scores, key=lambda score: score.mean)
    gains = [gain(best, score) for score in scores]
    return [g.mean <= max(errors * g.error, least) for g in gains]


def choose(scores: Sequence[Score], least: float = 0.0) -> int:
    """Index of the candidate to keep; scores are in order of cost."""
    return near_best(scores, least).index(True)


def ranked(scores: Sequence[Score], least: float = 0.0) -> list[int]:
    """Indices from the likeliest choice to the least likely: candidates that may be as good as the
    best by cost, then the others by score. The best itself is always among the first two.

    Early scores show which candidate learns fast rather than which is sufficient, so a candidate
    may be `PATIENCE` standard errors behind here, where the final choice allows one. With few
    frames that can be several dB, and without the place kept for the best, cheap candidates would
    exclude the one that they have to be compared with.
    """
    places = range(len(scores))
    near = near_best(scores, least, PATIENCE)
    order = sorted(places, key=lambda k: (not near[k], k if near[k] else -scores[k].mean))
    best = max(places, key=lambda k: scores[k].mean)
    if order.index(best) > 1:
        order.remove(best)
        order.insert(1, best)
    return order


# Successive halving under a budget (Jamieson & Talwalkar 2016, arXiv:1502.07943).

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
    least: float,
    what: str = "",
) -> Halving:
    """Halve until two candidates are left, and choose between them.

    Args:
        plan: from `plan`. costs: of a step of each candidate, the cheapest first.
        frames: number of frames scored in each round. advance: trains and scores a candidate.
        budget: each training is entered before it runs, as `what`.
        least: dB, as `near_best` has it.

    Raises:
        BudgetError: the plan exceeds the budget; no training beyond it has run.
    """
    scores: list[dict[int, Score]] = [{} for _ in costs]
    alive, before = list(range(len(costs))), 0
    for count, until in zip(plan.alive, plan.until, strict=True):
        if len(alive) > count:
            order = ranked([scores[k][before] for k in alive], least)
            alive = sorted(alive[place] for place in order[:count])
        for k in alive:
            budget.spend(f"{what}[{k}]", costs[k] * (until - before + SCORING * frames))
            scores[k][until] = advance(k, until)
        before = until
    chosen = alive[choose([scores[k][before] for k in alive], least)]
    return Halving(chosen, tuple(scores))
