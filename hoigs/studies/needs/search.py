"""The search: every ladder is climbed in turn, and what it finds is laid over the spec."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

from hoigs.core.clip import Clip
from hoigs.core.errors import SpecError
from hoigs.core.registry import Registry, default_registry
from hoigs.core.spec import Spec
from hoigs.studies.needs.criterion import Criterion, Gain, Score, gain
from hoigs.studies.needs.halving import SCORING, BudgetError, Climbed, Ledger, climb, plan
from hoigs.studies.needs.refit import UNSEEN, cheapest_refit
from hoigs.studies.needs.rungs import (
    Ladder,
    Overrides,
    Rung,
    as_settings,
    expanded,
    laid,
    multiplied,
)
from hoigs.studies.needs.selection import SELECTION, selection_view
from hoigs.studies.needs.trial import Trial, alone

TOTAL = 2.5  # full trainings that the search and what comes after it may cost together
FINAL, AFTER = 1.0, 0.1  # of these: the final training, and a reserve for work on its result
SETTLES = "train.rates.settle"
SETTLE = 0.1  # of trials, answer and tuning: at steady rates, where one ends is a matter of chance

Report = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """How to search.

    Attributes:
        criterion: "one-se" or "bic". least: dB that nobody would see (`criterion.near_best`).
        share, frames: of the training frames, and how many at least, held back.
        budget: full trainings that everything may cost, the final training included.
    """

    criterion: Criterion = "one-se"
    least: float = 0.1
    share: float = 0.05
    frames: int = 3
    budget: float = TOTAL


@dataclass(frozen=True)
class Step:
    """What became of one rung.

    Attributes:
        score: at `steps`, the last at which the chosen rung was looked at too. over_chosen: gain
            over the chosen rung there. problem: why it could not be tried at all.
    """

    rung: Rung
    steps: int = 0
    score: Score | None = None
    over_chosen: Gain | None = None
    seconds: float = 0.0
    problem: str = ""


@dataclass(frozen=True)
class Answer:
    """What one ladder says about one block of the spec.

    Attributes:
        block: key below `model`, or "" of a pair. chosen: its rung, None where nothing changes.
        skipped: why the ladder was not climbed. overrides, afterwards: of the chosen rung.
        refitted: rung that scored best, whose motion the chosen one holds (`refit`).
    """

    ladder: Ladder
    block: str
    chosen: Rung | None
    steps: tuple[Step, ...] = ()
    skipped: str = ""
    overrides: Overrides = field(default_factory=dict)
    refitted: str = ""
    afterwards: Overrides = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The ladder, and the block where it has another name: "human planes of dancer"."""
        name = self.ladder.name
        return name if self.block in ("", name) else f"{name} of {self.block}"

    def step(self, rung: Rung) -> Step:
        return next(s for s in self.steps if s.rung is rung)


@dataclass(frozen=True)
class Needs:
    """The whole answer.

    Attributes:
        start: the base spec with what the user had set. overrides: of it. spec: with these.
        frames: positions that were held back.
        full: steps of a full training. ledger: what the search cost, in its steps.
        seconds: the search took; full_seconds: a full training would take, at the pace measured.
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
    ledger: Ledger
    seconds: float
    full_seconds: float


@dataclass
class Search:
    """One search; `run` does it.

    Args:
        clip: at training width. base: spec name or file. given: settings laid over it by the user.
        ladders: from `load_ladders`.
    """

    clip: Clip
    base: str
    ladders: Sequence[Ladder]
    given: Sequence[str] = ()
    settings: Settings = field(default_factory=Settings)
    registry: Registry | None = None
    device: str = "cpu"
    report: Report = lambda line: None

    def run(self) -> Needs:
        """Climb every ladder.

        Raises:
            SpecError, ClipError, BudgetError: the base spec is none, there are too few training
                frames, or too few steps to ask anything.
        """
        self.registry = self.registry or default_registry()
        full = Spec.load(self.base, overrides=self.given, registry=self.registry)
        # as a file of its own, so that rungs are laid over what the user has set, block by block
        with tempfile.TemporaryDirectory(prefix="hoigs-needs-") as folder:
            self.start = Path(folder) / "start.yaml"
            self.start.write_text(full.dump(), encoding="utf-8")
            return self._run(full)

    def _run(self, full: Spec) -> Needs:
        began = time.perf_counter()
        self.view = selection_view(self.clip, self.settings.share, self.settings.frames)
        self.held = self.view.split[SELECTION]
        steps = full.train.steps
        self.most = steps
        self.ledger = Ledger((self.settings.budget - FINAL - AFTER) * steps)
        self.blocks, self.entities = _blocks(full, self.clip)
        pace = self._pace(full)
        self.found: Overrides = {} if self._settled(full) else {SETTLES: SETTLE}
        self.chosen: dict[str, set[str]] = {}
        answers: list[Answer] = []
        waiting = [(ladder, block) for ladder in self.ladders for block in self._places(ladder)]
        for i, (ladder, block) in enumerate(waiting):
            shares = sum(other.share for other, _ in waiting[i:])
            answer = self._answer(ladder, block, self.ledger.left * ladder.share / shares)
            self.found = laid(self.found, answer.overrides)
            if answer.chosen is not None:
                self.chosen.setdefault(ladder.name, set()).add(answer.chosen.name)
            self.report(told(answer))
            answers.append(answer)
        for answer in answers:
            self.found = laid(self.found, answer.afterwards)
        return Needs(
            clip=self.clip.name,
            base=self.base,
            start=full,
            spec=self._spec(self.found),
            overrides=self.found,
            answers=tuple(answers),
            settings=self.settings,
            frames=tuple(self.held),
            full=steps,
            ledger=self.ledger,
            seconds=time.perf_counter() - began,
            full_seconds=pace * steps,
        )

    def _settled(self, full: Spec) -> bool:
        """Whether the base spec or the user has said how rates end."""
        said = {setting.partition("=")[0].strip() for setting in self.given}
        return SETTLES in said or full.train.rates.settle < 1

    def _spec(self, overrides: Mapping[str, object]) -> Spec:
        settings = as_settings(overrides)
        return Spec.load(self.start, overrides=settings, registry=self.registry)

    def _places(self, ladder: Ladder) -> list[str]:
        """Blocks that a ladder is climbed for, one by one."""
        if ladder.kind == "pair":
            return [""] if self.blocks["human"] and self.blocks["object"] else []
        return list(self.blocks[ladder.kind])

    def _pace(self, full: Spec, steps: int = 6) -> float:
        """Seconds of a step of the full spec, for the report: no clock chooses anything."""
        names = [name for names in self.entities.values() for name in names]
        trial = {"train.preview_every": 0, "train.loss.depth_fit": "scale",
                 "train.loss.lpips": 0.0, "train.loss.face": 0.0}  # fmt: skip
        self.ledger.spend("pace of a full training", steps + SCORING * len(self.held))
        spec, registry = self._spec(trial), self._registry()
        model = Trial(spec, self.view, "background", names, registry, self.device)
        paces = []
        for step in range(1, steps + 1):
            began = time.perf_counter()
            model.trainer.train(until=step)
            paces.append(time.perf_counter() - began)
        return median(paces[2:])  # one of them may capture CUDA graphs

    def _registry(self) -> Registry:
        assert self.registry is not None
        return self.registry

    def _answer(self, ladder: Ladder, block: str, budget: float) -> Answer:
        """Climb one ladder for one block, or say why not."""
        blocks = self.blocks if not block else self.blocks | {ladder.kind: [block]}
        for other, rungs in ladder.unless.items():
            taken = self.chosen.get(other, set()) & set(rungs)
            if taken:
                why = f"{other} is {' and '.join(sorted(taken))}"
                if not ladder.else_cheapest:
                    return Answer(ladder, block, None, skipped=why)
                return self._chosen(ladder, block, ladder.rungs[0], blocks, skipped=why)
        if all(rung.times for rung in ladder.rungs) and not any(
            self._overrides(rung, blocks) for rung in ladder.rungs
        ):
            return Answer(ladder, block, None, skipped="what has been chosen has none of it")
        held = len(self.held)
        try:
            longest = plan([r.cost for r in ladder.rungs], budget, held, self.most).steps
        except BudgetError as error:
            return Answer(ladder, block, None, skipped=str(error))
        trials, steps = self._trials(ladder, block, blocks, longest)
        tried = [rung for rung in ladder.rungs if rung.name in trials]
        place, refitted = 0, ""
        if len(tried) > 1:
            costs = [rung.cost for rung in tried]
            climbed = climb(
                plan(costs, budget, held, longest),
                costs,
                held,
                lambda k, until: trials[tried[k].name].advance(until),
                self.ledger,
                what=f"{ladder.name} {block}".strip(),
                criterion=self.settings.criterion,
                least=self.settings.least if ladder.least is None else ladder.least,
                price=ladder.price,
            )
            place = cheapest_refit(tried, climbed.chosen, trials, self.clip)
            if place != climbed.chosen:
                refitted = tried[climbed.chosen].name
                climbed = replace(climbed, chosen=place)
            for k, rung in enumerate(tried):
                steps[rung.name] = _step(rung, k, climbed, trials[rung.name].seconds)
        chosen = tried[place]
        rows = tuple(steps.get(rung.name, Step(rung)) for rung in ladder.rungs)
        why = "" if len(tried) > 1 else "no other of its rungs can be built here"
        return self._chosen(
            ladder, block, chosen, blocks, steps=rows, skipped=why, refitted=refitted
        )

    def _chosen(
        self,
        ladder: Ladder,
        block: str,
        rung: Rung,
        blocks: Mapping[str, Sequence[str]],
        *,
        skipped: str,
        steps: tuple[Step, ...] = (),
        refitted: str = "",
    ) -> Answer:
        own, later = self._overrides(rung, blocks), expanded(rung.afterwards, blocks)
        return Answer(ladder, block, rung, steps, skipped, own, refitted, later)

    def _overrides(self, rung: Rung, blocks: Mapping[str, Sequence[str]]) -> Overrides:
        """What a rung sets, over what has been found so far."""
        own = expanded(rung.overrides, blocks)
        so_far = self._spec(laid(self.found, own)).model_dump(mode="json")
        return laid(own, multiplied(expanded(rung.times, blocks), so_far))

    def _trials(
        self, ladder: Ladder, block: str, blocks: Mapping[str, Sequence[str]], steps: int
    ) -> tuple[dict[str, Trial], dict[str, Step]]:
        """A trial of each rung that can be built on this clip; why the others cannot."""
        names = self._names(block)
        trials: dict[str, Trial] = {}
        failed: dict[str, Step] = {}
        for rung in ladder.rungs:
            overrides = laid(self.found, expanded(ladder.during, blocks))
            overrides = laid(overrides, self._overrides(rung, blocks))
            overrides = laid(overrides, alone(ladder.kind, names, self.blocks, steps))
            spec = self._spec(overrides)  # a rung that is no spec is a mistake, and is told at once
            try:
                trials[rung.name] = Trial(
                    spec,
                    self.view,
                    ladder.region,
                    names,
                    self._registry(),
                    self.device,
                )
            except SpecError as error:
                failed[rung.name] = Step(rung, problem=str(error))
        if not trials:
            reasons = "\n".join(f"{name}: {step.problem}" for name, step in failed.items())
            raise SpecError(f"no rung of ladder {ladder.name} can be built:\n{reasons}")
        return trials, failed

    def _names(self, block: str) -> list[str]:
        """Entities that a trial models."""
        if block:
            return self.entities[block]
        keys = [*self.blocks["human"], *self.blocks["object"]]
        return [name for key in keys for name in self.entities[key]]


def _step(rung: Rung, k: int, climbed: Climbed, seconds: float) -> Step:
    steps, own, chosen = climbed.together(k, climbed.chosen)
    over = None if k == climbed.chosen else gain(own, chosen)
    return Step(rung, steps, own, over, seconds)


def _blocks(spec: Spec, clip: Clip) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Keys of model blocks by kind, and entities by key, of what the clip has."""
    blocks: dict[str, list[str]] = {"scene": [], "human": [], "object": []}
    entities: dict[str, list[str]] = {}
    for name, kind in {"scene": "scene", **clip.kinds}.items():
        found = spec.block(name, kind)
        if not spec.selects(name, kind) or found is None:
            continue
        key = found[0]
        if key not in entities:
            blocks[kind].append(key)
        entities.setdefault(key, []).append(name)
    return blocks, entities


def told(answer: Answer) -> str:
    """An answer in one line: "object: rigid, 3 knots, because …"."""
    name = answer.title
    if answer.chosen is None:
        return f"{name}: unchanged, because {answer.skipped}"
    if answer.skipped:
        return f"{name}: {answer.chosen.name}, because {answer.skipped}"
    reasons = [answer.chosen.why]
    if answer.refitted:
        reasons.append(f"the motion of {answer.refitted} fits it within {UNSEEN:g} pixel")
    rungs = list(answer.ladder.rungs)
    place = rungs.index(answer.chosen)
    cheaper = [s for s in answer.steps[:place] if s.over_chosen is not None]
    dearer = [s for s in answer.steps[place + 1 :] if s.over_chosen is not None]
    if cheaper:
        best = max(cheaper, key=lambda s: s.over_chosen.mean if s.over_chosen else 0.0)
        reasons.append(f"{best.rung.name} is {best.over_chosen} from it")
    if dearer:
        best = max(dearer, key=lambda s: s.over_chosen.mean if s.over_chosen else 0.0)
        reasons.append(f"{best.rung.name} would give {best.over_chosen}")
    return f"{name}: {answer.chosen.name}, because {'; '.join(reasons)}"
