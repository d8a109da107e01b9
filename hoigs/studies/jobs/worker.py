"""The module that a job's own process runs: `hoigs.studies.jobs.worker JOB RUNS_AT_ONCE`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoigs.core.errors import HoigsError
from hoigs.studies.jobs.cost import train_measured
from hoigs.studies.jobs.job import SCORES, Job, JobState, write_record

if TYPE_CHECKING:
    from hoigs.runs.loaded_run import LoadedRun

TIMED_FRAMES, TIMING_BUDGET_S = 30, 15.0  # rough, as other jobs run beside


def run_job(job: Job, runs_at_once: int = 1) -> None:
    """Train and score; see `train_job`."""
    from hoigs.evaluation.evaluate import score

    weights = Path(job.lpips_weights) if job.lpips_weights else None
    loaded = train_job(job, runs_at_once, lpips_weights=weights)
    if loaded is None:
        return
    settings = loaded.spec.evaluation
    evaluation = score(
        loaded.model,
        loaded.clip,
        lpips_weights=weights,
        held_out=settings.held_out,
        test_pose=settings.test_pose,
        test_camera=settings.test_camera,
        fit_steps=settings.fit_steps,
        timing_frames=TIMED_FRAMES,
        timing_warmup=3,
        timing_budget_s=TIMING_BUDGET_S,
    )
    evaluation.save(job.folder / SCORES)


def train_job(job: Job, runs_at_once: int, **options: Any) -> LoadedRun | None:
    """The trained run of `job`, from where an interrupted one stopped; None when it is done.

    Args:
        runs_at_once: how many runs share the machine; kept with what the training cost.
        options: more arguments of `Session.open`.

    Raises:
        HoigsError: the spec does not fit the clip, or the training failed.
    """
    from hoigs.runs.loaded_run import LoadedRun
    from hoigs.training.session import Session

    state = job.state()
    if state is JobState.done:
        return None
    plugins = [Path(p) for p in job.plugins]
    session = Session.open(
        Path(job.clip),
        job.spec,
        out=job.folder,
        overrides=job.settings,
        device=job.device,
        resume=state is JobState.started,
        overwrite=state is JobState.absent,
        plugins=plugins,
        **options,
    )
    if session.spec.hash() != job.spec_hash:
        raise HoigsError(f"{job.spec} has changed since the study was begun; run the command again")
    write_record(job.folder, job.identity)
    train_measured(session, job, runs_at_once)
    return LoadedRun.open(job.folder, clip=job.clip, device=job.device, plugins=plugins)


def main(kind: type[Job] = Job, run: Callable[[Any, int], None] = run_job) -> None:
    """Run the job in argv; user errors are one message and exit code 2, as on the command line."""
    try:
        run(kind.parse(sys.argv[1]), int(sys.argv[2]))
    except HoigsError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
