"""One job in a process of its own: `python -m hoigs.studies.worker JOB RUNS_AT_ONCE PARENT`."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.studies.cost import train_measured
from hoigs.studies.job import SCORES, Job, JobState, write_record

TIMED_FRAMES, TIMING_BUDGET_S = 30, 15.0  # other jobs run beside: a rough number is what there is
PARENT_POLL_S = 0.25


def run_job(job: Job, runs_at_once: int = 1) -> None:
    """Train and score, from where an interrupted run of the same job stopped.

    Args:
        runs_at_once: how many runs share the machine; kept with what the training cost.

    Raises:
        HoigsError: the spec does not fit the clip, or the training failed.
    """
    from hoigs.evaluation.evaluate import evaluate
    from hoigs.training.session import LoadedRun, Session

    state = job.state()
    if state is JobState.done:
        return
    weights = Path(job.lpips_weights) if job.lpips_weights else None
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
        lpips_weights=weights,
    )
    if session.spec.hash() != job.spec_hash:
        raise HoigsError(f"{job.spec} has changed since the study was begun; start them again")
    write_record(job.folder, job.identity)
    train_measured(session, job, runs_at_once)
    loaded = LoadedRun.open(job.folder, clip=job.clip, device=job.device, plugins=plugins)
    settings = loaded.spec.evaluation
    evaluation = evaluate(
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


def main(kind: type[Job] = Job, run: Callable[[Any, int], None] = run_job) -> None:
    """Exit code 2 and one message for what a user can mend, as the command line does."""
    threading.Thread(target=_end_with, args=(int(sys.argv[3]),), daemon=True).start()
    try:
        run(kind.parse(sys.argv[1]), int(sys.argv[2]))
    except HoigsError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _end_with(parent: int) -> None:
    """A study that was killed outright leaves no run that the next would collide with."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(1)


if __name__ == "__main__":
    main()
