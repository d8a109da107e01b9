"""Run a stress study: direct checks, then chains of trainings, each until its seed breaks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from hoigs.core.registry import default_registry
from hoigs.core.spec import Spec
from hoigs.evaluation.protocol import Value
from hoigs.studies.chart_run import protocol_of
from hoigs.studies.cost import read_cost
from hoigs.studies.job import Job, JobState
from hoigs.studies.pool import Report, run_jobs
from hoigs.studies.stress.bench import TINY, Bench
from hoigs.studies.stress.capability import MEANING, Capability
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.direct import STATIC, Composed, make_clips, run_direct
from hoigs.studies.stress.finding import Finding
from hoigs.studies.stress.measures import judged_values
from hoigs.studies.stress.plan import Chain, StressStudy, clip_names, plan_chains
from hoigs.studies.stress.verdict import Level, Seed, Verdict, judge, verdict_of

Tell = Callable[[str], None]


@dataclass
class _Progress:
    """Where one chain stands."""

    chain: Chain
    whole: bool
    out: str
    levels: list[Level] = field(default_factory=list)
    first: Mapping[str, Value] = field(default_factory=dict)

    @property
    def waits_for(self) -> Job | None:
        """The training that comes next; None when all is known."""
        broken = any(not level.stands for level in self.levels)
        if len(self.levels) == len(self.chain.jobs) or (broken and not self.whole):
            return None
        return self.chain.jobs[len(self.levels)]

    def take(self, why: str | None) -> None:
        """What the training waited for has come to, or why it failed."""
        job = self.chain.jobs[len(self.levels)]
        value, run = self.chain.knob.values[len(self.levels)], job.run.removeprefix(self.out)
        if why is not None:
            self.levels.append(Level(value, False, f"the training failed: {why}", {}, run))
            return
        found = judged_values(job.scores())
        self.first = self.first or found
        self.levels.append(judge(self.chain.knob, value, found, self.first, run))


def run_stress(
    study: StressStudy,
    *,
    workers: int = 1,
    threads: int = 1,
    limit_s: float | None = None,
    report: Report | None = None,
    tell: Tell = lambda line: None,
) -> list[Verdict]:
    """Every case for every spec, in order; see `pool.run_jobs`.

    A seed is given harder values until it breaks; what is harder than that it does not stand
    either (`StressStudy.whole` runs them all the same).

    Raises:
        HoigsError: a spec that cannot be used; nothing has been trained by then.
    """
    deadline = None if limit_s is None else time.monotonic() + limit_s
    registry = default_registry(list(study.plugins))
    for row in study.specs:  # a wrong name is told before clips are made
        Spec.load(str(row.spec), overrides=[*study.settings, *row.settings], registry=registry)
    names = [n for c in study.cases if c.knob is not None for n in clip_names(c.knob, study.base)]
    make_clips([TINY, STATIC, *names], workers, tell)
    specs: dict[str, Composed] = {
        row.label: (str(row.spec), (*study.settings, *row.settings), tuple(map(str, study.plugins)))
        for row in study.specs
    }
    has = {label: Bench.compose(*composed).capabilities for label, composed in specs.items()}

    def told(case: str, spec: str, finding: Finding) -> None:
        word = "holds" if finding.passed else "FAILS"
        tell(f"{case}{' ' + spec if spec else ''}: {word}: {finding.measured}")

    direct = run_direct(study.cases, specs, has, workers, told)
    chains = plan_chains(study, has)
    left = None if deadline is None else max(0.0, deadline - time.monotonic())
    progress = _train(study, chains, workers, threads, left, report)
    return [
        _verdict(study, case, row.label, has[row.label], direct, progress)
        for case in study.cases
        for row in study.specs
    ]


def _train(
    study: StressStudy,
    chains: Sequence[Chain],
    workers: int,
    threads: int,
    limit_s: float | None,
    report: Report | None,
) -> list[_Progress]:
    progress = [_Progress(chain, study.whole, f"{study.out}/") for chain in chains]
    asked: set[str] = set()
    over: dict[str, str | None] = {}  # runs that have ended, and why they failed

    def follow(job: Job, why: str | None) -> list[Job]:
        over[job.run] = why
        return advance()

    def advance() -> list[Job]:
        """Take what there is, and name the trainings that chains wait for."""
        found = []
        for own in progress:
            while (job := own.waits_for) is not None and job.run in over:
                own.take(over[job.run])
            if job is not None and job.run not in asked:
                asked.add(job.run)
                found.append(job)
        return found

    run_jobs(
        advance(), workers=workers, threads=threads, limit_s=limit_s, report=report, follow=follow
    )
    return progress


def _verdict(
    study: StressStudy,
    case: Case,
    label: str,
    has: frozenset[Capability],
    direct: Mapping[tuple[str, str], Finding],
    progress: Sequence[_Progress],
) -> Verdict:
    if case.why_not is not None:
        return Verdict(case.id, label, "not applicable", case.why_not)
    lacks = [MEANING[c] for c in case.concerns if c not in has]
    if lacks:
        return Verdict(case.id, label, "not applicable", f"has not: {', '.join(lacks)}")
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
