"""Run a stress study: chains of trainings, each until its seed fails."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.system.environments import safe_children
from hoigs.evaluation.protocol import Value
from hoigs.studies.execution.local import Executor
from hoigs.studies.jobs.cost import read_cost
from hoigs.studies.jobs.job import ClipFolders, Job, JobState, make_job
from hoigs.studies.jobs.results import Row, protocol_of
from hoigs.studies.jobs.run_jobs import Report, run_jobs
from hoigs.studies.stress.capabilities import (
    MEANING,
    TINY,
    Capability,
    capabilities,
    compose_small,
    modelled,
    small_settings,
)
from hoigs.studies.stress.case import Case, Sweep
from hoigs.studies.stress.measures import scored_values
from hoigs.studies.stress.verdict import Level, Seed, Verdict, level_of, verdict_of

# StressJob: one short training at one value of a sweep, and the clip that scores it.


@dataclass(frozen=True)
class StressJob(Job):
    """A Job that may be scored on another clip.

    Attributes:
        scoring_clip: folder of the clip whose test frames score the model; "" is the training clip.
        allow_faults: train in spite of faults of the clip.
    """

    worker: ClassVar[str] = "hoigs.studies.stress.worker"

    scoring_clip: str = ""
    allow_faults: bool = False

    @property
    def identity(self) -> dict[str, str]:
        scoring = {"judge": Path(self.scoring_clip).name} if self.scoring_clip else {}
        return super().identity | scoring


# The trainings of a stress study: for each sweep, spec and seed a chain of harder values.


# settings of every clip, which those of the sweep override
BASE = (
    "width=96&frames=24&fps=6&edge_samples=4&held_out_views=4&test_frames=6&scene_points=5000"
    "&object_points=1000"
)


@dataclass(frozen=True)
class StressStudy:
    """A study to run.

    Attributes:
        cases: chosen. specs: of `jobs.results.parse_variants`. seeds: how many, from 0.
        steps, points: of every training; Gaussians at its start.
        base: settings of every clip. whole: run every value even after a seed has failed one.
        settings: overrides of every spec. out, device, plugins: as for other studies.
    """

    cases: Sequence[Case]
    specs: Sequence[Row]
    out: Path
    seeds: int = 3
    steps: int = 300
    points: int = 4000
    base: str = BASE
    whole: bool = False
    settings: tuple[str, ...] = ()
    device: str = "cpu"
    plugins: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Chain:
    """The trainings of one case, spec and seed, from the easiest value to the hardest."""

    case: Case
    spec: Row
    seed: int
    jobs: tuple[StressJob, ...]


def clip_names(sweep: Sweep, base: str) -> list[str]:
    """The built-in clip of each value of a sweep; one clip if the sweep varies the spec."""
    start, _, own = sweep.clip.partition("?")
    found = []
    for value in sweep.values:
        varied = [setting.replace("{}", f"{value:g}") for setting in sweep.sets]
        found.append(f"builtin:{start}?" + "&".join([base, *filter(None, [own]), *varied]))
    return found


def plan_chains(
    study: StressStudy, capabilities: Mapping[str, frozenset[Capability]]
) -> list[Chain]:
    """Every chain whose case concerns its spec; built-in clips are generated unless cached.

    Args:
        capabilities: of each spec, by label.
    """
    folders, registry = ClipFolders(), default_registry(list(study.plugins))
    own = {
        row.label: Spec.load(
            str(row.spec), overrides=[*study.settings, *row.settings], registry=registry
        )
        for row in study.specs
    }
    return [
        _chain(study, case, row, own[row.label], seed, folders)
        for case in study.cases
        for row in study.specs
        if set(case.concerns) <= capabilities[row.label]
        for seed in range(study.seeds)
    ]


def _chain(
    study: StressStudy, case: Case, row: Row, spec: Spec, seed: int, folders: ClipFolders
) -> Chain:
    sweep = case.sweep
    assert row.spec is not None
    given = [*study.settings, *row.settings]
    small = small_settings(spec, study.points, study.steps)
    names = clip_names(sweep, study.base)
    first = folders.get(names[0])[0]
    jobs = []
    for name, value in zip(names, sweep.values, strict=True):
        folder, _, digest = folders.get(name)
        scoring = str(first) if sweep.scored_on == "first" and folder != first else ""
        # by content of the clip: cases that share their first clip share its training
        key = folder.name.removeprefix("builtin-")[:8]
        label = f"{sweep.clip.partition('?')[0]}-{key}" + ("-judged" if scoring else "")
        settings = [*small, *given, *block_settings(spec, sweep, value), f"train.seed={seed}"]
        job = make_job(
            study.out, folder, label, digest, row.spec, settings, kind=StressJob,
            device=study.device, plugins=tuple(map(str, study.plugins)), scoring_clip=scoring,
            allow_faults=sweep.faults,
        )  # fmt: skip
        assert isinstance(job, StressJob)
        jobs.append(job)
    return Chain(case, row, seed, tuple(jobs))


def block_settings(spec: Spec, sweep: Sweep, value: float) -> list[str]:
    """Overrides by a sweep of the spec, in each component of a model block with such a setting."""
    found = []
    for name, _ in modelled(spec):
        for place, template in sweep.blocks.items():
            part, _, key = place.partition(".")
            if key in getattr(spec.model[name], part).settings:
                found.append(f"model.{name}.{place}={template.replace('{}', f'{value:g}')}")
    return found


def make_clips(
    names: Sequence[str], workers: int, log: Callable[[str], None] = lambda line: None
) -> None:
    """Generate the built-in clips that are not cached yet."""
    unique = list(dict.fromkeys(names))
    spawn = multiprocessing.get_context("spawn")
    count = max(1, min(workers, len(unique)))
    with safe_children(), ProcessPoolExecutor(count, spawn, _one_thread) as pool:
        waiting = [pool.submit(_make_clip, name) for name in unique]
        for i, done in enumerate(as_completed(waiting)):
            done.result()
            if (i + 1) % 10 == 0 or i + 1 == len(unique):
                log(f"{i + 1} of {len(unique)} clips")


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _make_clip(name: str) -> None:
    from hoigs.runs.clip_source import clip_folder

    clip_folder(name)


@dataclass
class _Progress:
    """Progress of one chain."""

    chain: Chain
    whole: bool
    out: str
    levels: list[Level] = field(default_factory=list)
    first: Mapping[str, Value] = field(default_factory=dict)

    @property
    def next_job(self) -> Job | None:
        """The next training; None when the chain is complete."""
        broken = any(not level.stands for level in self.levels)
        if len(self.levels) == len(self.chain.jobs) or (broken and not self.whole):
            return None
        return self.chain.jobs[len(self.levels)]

    def record(self, why: str | None) -> None:
        """Add the result of the next training, or the reason why it failed."""
        job = self.chain.jobs[len(self.levels)]
        value, run = self.chain.case.sweep.values[len(self.levels)], job.run.removeprefix(self.out)
        if why is not None:
            self.levels.append(Level(value, False, f"the training failed: {why}", {}, run))
            return
        found = scored_values(job.scores())
        self.first = self.first or found
        self.levels.append(level_of(self.chain.case.sweep, value, found, self.first, run))


def run_stress(
    study: StressStudy,
    *,
    executor: Executor | None = None,
    limit_s: float | None = None,
    report: Report | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> list[Verdict]:
    """The verdict on every case for every spec, in order; options as for `run_jobs`.

    A seed runs harder values until it fails one, and counts as failing all harder ones
    (`StressStudy.whole` runs them too).

    Args:
        executor: where the trainings run.
        report: called with jobs, as for `run_jobs`. log: called with lines of text on the clips.

    Raises:
        HoigsError: a spec is invalid; this is checked before any training.
    """
    deadline = None if limit_s is None else time.monotonic() + limit_s
    registry = default_registry(list(study.plugins))
    for row in study.specs:  # raises before clips are generated
        Spec.load(str(row.spec), overrides=[*study.settings, *row.settings], registry=registry)
    names = [name for case in study.cases for name in clip_names(case.sweep, study.base)]
    make_clips([TINY, *names], executor.slots if executor else 1, log)
    has = {
        row.label: capabilities(
            *compose_small(
                str(row.spec), (*study.settings, *row.settings), tuple(map(str, study.plugins))
            )[1:]
        )
        for row in study.specs
    }
    chains = plan_chains(study, has)
    left = None if deadline is None else max(0.0, deadline - time.monotonic())
    progress = _train(study, chains, executor, left, report)
    return [
        _verdict(case, row.label, has[row.label], progress)
        for case in study.cases
        for row in study.specs
    ]


def _train(
    study: StressStudy,
    chains: Sequence[Chain],
    executor: Executor | None,
    limit_s: float | None,
    report: Report | None,
) -> list[_Progress]:
    progress = [_Progress(chain, study.whole, f"{study.out}/") for chain in chains]
    started: set[str] = set()
    over: dict[str, str | None] = {}  # runs that have ended, and the error if they failed

    def follow(job: Job, why: str | None) -> list[Job]:
        over[job.run] = why
        return advance()

    def advance() -> list[Job]:
        """Record trainings that have ended, and return those that chains need next."""
        found = []
        for own in progress:
            while (job := own.next_job) is not None and job.run in over:
                own.record(over[job.run])
            if job is not None and job.run not in started:
                started.add(job.run)
                found.append(job)
        return found

    run_jobs(advance(), executor, limit_s=limit_s, report=report, follow=follow)
    return progress


def _verdict(
    case: Case, label: str, has: frozenset[Capability], progress: Sequence[_Progress]
) -> Verdict:
    lacks = [MEANING[c] for c in case.concerns if c not in has]
    if lacks:
        return Verdict(case.id, label, "not applicable", f"lacks: {', '.join(lacks)}")
    mine = [p for p in progress if p.chain.case is case and p.chain.spec.label == label]
    seeds = [Seed(p.chain.seed, tuple(p.levels)) for p in mine]
    jobs = [job for p in mine for job in p.chain.jobs[: len(p.levels)]]
    done = [job for job in jobs if job.state() is JobState.done]
    costs = [read_cost(job.folder) for job in done]
    machines = tuple(dict.fromkeys(word for cost in costs for word in cost.machines))
    protocol = protocol_of(done[0].scores(), costs[0]) if done else ()
    return verdict_of(
        case, label, case.is_limitation(has), seeds, machines=machines, protocol=tuple(protocol)
    )
