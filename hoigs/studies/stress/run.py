"""Run a stress study: direct checks, then chains of trainings, each until its seed fails."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.evaluation.protocol import Value
from hoigs.studies.execution.executor import Executor
from hoigs.studies.jobs.cost import read_cost
from hoigs.studies.jobs.job import Job, JobState
from hoigs.studies.jobs.protocol import protocol_of
from hoigs.studies.jobs.run_jobs import Report, run_jobs
from hoigs.studies.stress.bench import TINY, Bench
from hoigs.studies.stress.capability import MEANING, Capability
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.check_result import CheckResult
from hoigs.studies.stress.direct import STATIC, Composed, make_clips, run_direct
from hoigs.studies.stress.measures import scored_values
from hoigs.studies.stress.plan import Chain, StressStudy, clip_names, plan_chains
from hoigs.studies.stress.verdict import Level, Seed, Verdict, level_of, verdict_of


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
        value, run = self.chain.sweep.values[len(self.levels)], job.run.removeprefix(self.out)
        if why is not None:
            self.levels.append(Level(value, False, f"the training failed: {why}", {}, run))
            return
        found = scored_values(job.scores())
        self.first = self.first or found
        self.levels.append(level_of(self.chain.sweep, value, found, self.first, run))


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
        executor: where the trainings run; the direct checks run here, as many at a time.
        report: called with jobs, as for `run_jobs`. log: called with lines of text on the rest.

    Raises:
        HoigsError: a spec is invalid; this is checked before any training.
    """
    deadline = None if limit_s is None else time.monotonic() + limit_s
    registry = default_registry(list(study.plugins))
    for row in study.specs:  # raises before clips are generated
        Spec.load(str(row.spec), overrides=[*study.settings, *row.settings], registry=registry)
    names = [n for c in study.cases if c.sweep is not None for n in clip_names(c.sweep, study.base)]
    workers = executor.slots if executor else 1
    make_clips([TINY, STATIC, *names], workers, log)
    specs: dict[str, Composed] = {
        row.label: (str(row.spec), (*study.settings, *row.settings), tuple(map(str, study.plugins)))
        for row in study.specs
    }
    has = {label: Bench.compose(*composed).capabilities for label, composed in specs.items()}

    def on_result(case: str, spec: str, result: CheckResult) -> None:
        word = "passed" if result.passed else "FAILED"
        log(f"{case}{' ' + spec if spec else ''}: {word}: {result.measured}")

    direct = run_direct(study.cases, specs, has, workers, on_result)
    chains = plan_chains(study, has)
    left = None if deadline is None else max(0.0, deadline - time.monotonic())
    progress = _train(study, chains, executor, left, report)
    return [
        _verdict(case, row.label, has[row.label], direct, progress)
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
    case: Case,
    label: str,
    has: frozenset[Capability],
    direct: Mapping[tuple[str, str], CheckResult],
    progress: Sequence[_Progress],
) -> Verdict:
    if case.why_not is not None:
        return Verdict(case.id, label, "not applicable", case.why_not)
    lacks = [MEANING[c] for c in case.concerns if c not in has]
    if lacks:
        return Verdict(case.id, label, "not applicable", f"lacks: {', '.join(lacks)}")
    nature = case.is_nature(has)
    own = direct.get((case.id, ""))
    if own is not None and (not own.passed or case.kind == "unit"):
        return Verdict(case.id, label, "pass" if own.passed else "fail", own.measured, ours=True)
    if case.kind == "per spec":
        found = direct[case.id, label]
        status = "pass" if found.passed else "nature" if nature else "fail"
        return Verdict(case.id, label, status, found.measured)  # type: ignore[arg-type]
    mine = [p for p in progress if p.chain.case is case and p.chain.spec.label == label]
    seeds = [Seed(p.chain.seed, tuple(p.levels)) for p in mine]
    jobs = [job for p in mine for job in p.chain.jobs[: len(p.levels)]]
    done = [job for job in jobs if job.state() is JobState.done]
    costs = [read_cost(job.folder) for job in done]
    machines = tuple(dict.fromkeys(word for cost in costs for word in cost.machines))
    protocol = protocol_of(done[0].scores(), costs[0]) if done else ()
    return verdict_of(case, label, nature, seeds, machines=machines, protocol=tuple(protocol))
