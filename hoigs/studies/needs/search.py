"""The search: successive halving of every search space in turn; each result changes the spec."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

from hoigs.core.errors import SpecError
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.studies.needs.calibration import calibrated
from hoigs.studies.needs.result import (
    AFTER,
    FINAL,
    SETTLE,
    SETTLES,
    Answer,
    Needs,
    Settings,
    Step,
    cheapest_refit,
    summary_line,
    track_moves,
)
from hoigs.studies.needs.search_space import (
    SCORING,
    BudgetError,
    Candidate,
    Gain,
    Halving,
    Overrides,
    SearchSpace,
    StepBudget,
    as_settings,
    expanded,
    gain,
    merged,
    multiplied,
    plan,
    successive_halving,
)
from hoigs.studies.needs.trial import SELECTION, Trial, isolated, selection_view

Report = Callable[[str], None]
UNTRIED = "short trials do not show what a cheaper one loses (--smallest tries them)"
CALIBRATION = 0.6  # of the budget of a search space that is calibrated


@dataclass
class Search:
    """A search for the candidate of each search space that a clip needs.

    Args:
        clip: at training width. base: spec name or file. given: settings of the user.
        search_spaces: from `load_search_spaces`.
    """

    clip: Clip
    base: str
    search_spaces: Sequence[SearchSpace]
    given: Sequence[str] = ()
    settings: Settings = field(default_factory=Settings)
    registry: Registry = field(default_factory=default_registry)
    device: str = "cpu"
    report: Report = lambda line: None

    def run(self) -> Needs:
        """Search every search space.

        Raises:
            SpecError, ClipError, BudgetError: the base spec is invalid, there are too few training
                frames, or too few steps to try anything.
        """
        full = Spec.load(self.base, overrides=self.given, registry=self.registry)
        # as a file, so that candidates change the user's settings block by block
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
        limit = (self.settings.budget - FINAL - AFTER) * steps
        self.budget = StepBudget(min(limit, self.settings.search_steps or limit))
        self.blocks, self.entities = _blocks(full, self.clip)
        pace = self._pace()
        self.found: Overrides = {} if self._settled(full) else {SETTLES: SETTLE}
        self.chosen: dict[str, set[str]] = {}
        answers: list[Answer] = []
        waiting = [(space, block) for space in self.search_spaces for block in self._places(space)]
        for i, (space, block) in enumerate(waiting):
            shares = sum(other.share for other, _ in waiting[i:] if self._searched(other))
            shares = max(shares, space.share)
            answer = self._answer(space, block, self.budget.left * space.share / shares)
            self.found = merged(self.found, answer.overrides)
            if answer.chosen is not None:
                self.chosen.setdefault(space.name, set()).add(answer.chosen.name)
            self.report(summary_line(answer))
            answers.append(answer)
        for answer in answers:
            self.found = merged(self.found, answer.afterwards)
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
            budget=self.budget,
            seconds=time.perf_counter() - began,
            full_seconds=pace * steps,
        )

    def _searched(self, space: SearchSpace) -> bool:
        return self.settings.smallest or not space.smallest_only

    def _turn_unknown(self, block: str) -> bool:
        """Whether the clip has a track of an object of the block, but not how it turns."""
        tracks = [self.clip.objects[n] for n in self._names(block) if n in self.clip.objects]
        return any(not track.rotation_known for track in tracks)

    def _settled(self, full: Spec) -> bool:
        """Whether the base spec or the user sets how rates end."""
        given = {setting.partition("=")[0].strip() for setting in self.given}
        return SETTLES in given or full.train.rates.settle < 1

    def _spec(self, overrides: Mapping[str, object]) -> Spec:
        settings = as_settings(overrides)
        return Spec.load(self.start, overrides=settings, registry=self.registry)

    def _places(self, space: SearchSpace) -> list[str]:
        """Blocks that a search space is tried for, one by one."""
        if space.kind == "pair":
            return [""] if self.blocks["human"] and self.blocks["object"] else []
        return list(self.blocks[space.kind])

    def _pace(self, steps: int = 6) -> float:
        """Seconds of a step of the full spec, for the report only; no choice depends on time."""
        names = [name for names in self.entities.values() for name in names]
        trial = {"train.preview_every": 0, "train.loss.depth_fit": "scale",
                 "train.loss.lpips": 0.0, "train.loss.face": 0.0}  # fmt: skip
        self.budget.spend("pace of a full training", steps + SCORING * len(self.held))
        spec = self._spec(trial)
        model = Trial(spec, self.view, "background", names, self.registry, self.device)
        paces = []
        for step in range(1, steps + 1):
            began = time.perf_counter()
            model.trainer.train(until=step)
            paces.append(time.perf_counter() - began)
        return median(paces[2:])  # one of them may capture CUDA graphs

    def _answer(self, space: SearchSpace, block: str, budget: float) -> Answer:
        """Search one space for one block, or give the reason why it is skipped."""
        blocks = self.blocks if not block else self.blocks | {space.kind: [block]}
        for other, candidates in space.unless.items():
            taken = self.chosen.get(other, set()) & set(candidates)
            if taken:
                why = f"{other} is {' and '.join(sorted(taken))}"
                if not space.else_cheapest:
                    return Answer(space, block, None, skipped=why)
                return self._chosen(space, block, space.candidates[0], blocks, skipped=why)
        if all(candidate.times for candidate in space.candidates) and not any(
            self._overrides(candidate, blocks) for candidate in space.candidates
        ):
            return Answer(space, block, None, skipped="no chosen component has this setting")
        if not self._searched(space):
            untried = [c for c in space.candidates if c.name == space.untried]
            if not untried:
                return Answer(space, block, None, skipped=UNTRIED)
            return self._chosen(space, block, untried[0], blocks, skipped=UNTRIED)
        unknown = space.turn_unknown
        if unknown and not self.settings.smallest and self._turn_unknown(block):
            return self._chosen(space, block, unknown, blocks, skipped=unknown.why)
        held, apart = len(self.held), CALIBRATION * budget if space.calibrated else 0.0
        budget -= apart
        try:
            longest = plan([r.cost for r in space.candidates], budget, held, self.most).steps
        except BudgetError as error:
            return Answer(space, block, None, skipped=str(error))
        trials, steps = self._trials(space, block, blocks, longest)
        tried = [candidate for candidate in space.candidates if candidate.name in trials]
        place, refitted = 0, ""
        useless: Mapping[int, Gain] = {}
        if len(tried) > 1:
            costs = [candidate.cost for candidate in tried]
            least = self.settings.least if space.least is None else space.least
            what = f"{space.name} {block}".strip()
            rounds = plan(costs, budget, held, longest)
            halving = successive_halving(
                rounds,
                costs,
                held,
                lambda k, until: trials[tried[k].name].advance(until),
                self.budget,
                least=least,
                what=what,
            )
            if space.calibrated:
                allowance = StepBudget(min(apart, self.budget.left))
                found = calibrated(
                    [trials[candidate.name] for candidate in tried], costs, halving, rounds.steps,
                    allowance, least=least, what=what,
                    moves=track_moves(self.clip, self._names(block)),
                )  # fmt: skip
                for entry in allowance.entries:
                    self.budget.spend(*entry)
                halving, useless = replace(halving, chosen=found.chosen), found.useless
            place = cheapest_refit(tried, halving.chosen, trials, self.clip)
            if place != halving.chosen:
                refitted = tried[halving.chosen].name
                halving = replace(halving, chosen=place)
            for k, candidate in enumerate(tried):
                step = _step(candidate, k, halving, trials[candidate.name].seconds)
                steps[candidate.name] = replace(step, useless=useless.get(k))
        chosen = tried[place]
        rows = tuple(steps.get(candidate.name, Step(candidate)) for candidate in space.candidates)
        why = "" if len(tried) > 1 else "no other of its candidates can be built here"
        return self._chosen(
            space, block, chosen, blocks, steps=rows, skipped=why, refitted=refitted
        )

    def _chosen(
        self,
        space: SearchSpace,
        block: str,
        candidate: Candidate,
        blocks: Mapping[str, Sequence[str]],
        *,
        skipped: str,
        steps: tuple[Step, ...] = (),
        refitted: str = "",
    ) -> Answer:
        own, later = self._overrides(candidate, blocks), expanded(candidate.afterwards, blocks)
        return Answer(space, block, candidate, steps, skipped, own, refitted, later)

    def _overrides(self, candidate: Candidate, blocks: Mapping[str, Sequence[str]]) -> Overrides:
        """Overrides of a candidate, given those chosen so far."""
        own = expanded(candidate.overrides, blocks)
        so_far = self._spec(merged(self.found, own)).model_dump(mode="json")
        return merged(own, multiplied(expanded(candidate.times, blocks), so_far))

    def _trials(
        self, space: SearchSpace, block: str, blocks: Mapping[str, Sequence[str]], steps: int
    ) -> tuple[dict[str, Trial], dict[str, Step]]:
        """A trial of each candidate that can be built on this clip; why the others cannot."""
        names = self._names(block)
        trials: dict[str, Trial] = {}
        failed: dict[str, Step] = {}
        for candidate in space.candidates:
            overrides = merged(self.found, expanded(space.during, blocks))
            overrides = merged(overrides, self._overrides(candidate, blocks))
            overrides = merged(overrides, isolated(space.kind, names, self.blocks, steps))
            spec = self._spec(overrides)  # raises: an invalid candidate is an error of its file
            try:
                trials[candidate.name] = Trial(
                    spec, self.view, space.region, names, self.registry, self.device
                )
            except SpecError as error:
                failed[candidate.name] = Step(candidate, problem=str(error))
        if not trials:
            reasons = "\n".join(f"{name}: {step.problem}" for name, step in failed.items())
            raise SpecError(f"no candidate of search space {space.name} can be built:\n{reasons}")
        return trials, failed

    def _names(self, block: str) -> list[str]:
        """Entities that a trial models."""
        if block:
            return self.entities[block]
        keys = [*self.blocks["human"], *self.blocks["object"]]
        return [name for key in keys for name in self.entities[key]]


def _step(candidate: Candidate, k: int, halving: Halving, seconds: float) -> Step:
    steps, own, chosen = halving.last_common(k, halving.chosen)
    over = None if k == halving.chosen else gain(own, chosen)
    return Step(candidate, steps, own, over, seconds=seconds)


def _blocks(spec: Spec, clip: Clip) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Keys of the model blocks by kind, and the clip's entities by key."""
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
