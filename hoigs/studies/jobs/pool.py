"""Run jobs, several at a time, each in its own process with a number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from hoigs.studies.jobs.job import Job, JobState

POLL_S = 0.05
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

OUT_OF_TIME = "the time limit came first; run the same command again"

Report = Callable[[Job, str], None]
Follow = Callable[[Job, str | None], Sequence[Job]]
Running = tuple[Job, subprocess.Popen[bytes]]


def run_jobs(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    threads: int = 1,
    limit_s: float | None = None,
    report: Report | None = None,
    follow: Follow | None = None,
) -> Mapping[str, str]:
    """Run the jobs that are not done; a job that fails does not stop the others.

    Args:
        workers: processes at a time. threads: of each, by OMP_NUM_THREADS.
        limit_s: stop after this many seconds; the next call continues.
        report: called with a job and "done before", "started", "done", "stopped" or "failed: why".
        follow: called with each job that has ended, and the error if it failed; the jobs that it
            returns are run too, before those that wait.

    Returns:
        The error of each job that failed, by run folder; all others are done. An interrupt
        terminates the processes; the next call continues from their last checkpoints.
    """
    deadline = None if limit_s is None else time.monotonic() + limit_s
    notify = report or (lambda job, word: None)
    waiting: deque[Job] = deque()
    failed: dict[str, str] = {}

    def sort(found: Iterable[Job]) -> None:
        """Queue jobs; those that are done are replaced by the jobs that follow them."""
        todo = deque(found)
        late: list[Job] = []
        while todo:
            job = todo.popleft()
            if job.state() is JobState.done:
                notify(job, "done before")
                todo.extend(follow(job, None) if follow else ())
            else:
                late.append(job)
        waiting.extendleft(reversed(late))

    sort(jobs)
    running: list[Running] = []
    try:
        while waiting or running:
            if deadline is not None and time.monotonic() > deadline:
                _stop(running, notify)
                return failed | {job.run: OUT_OF_TIME for job in (*waiting, *_jobs(running))}
            while waiting and len(running) < workers:
                job = waiting.popleft()
                notify(job, "started")
                running.append((job, _start(job, threads, workers)))
            time.sleep(POLL_S)
            for job, process in [pair for pair in running if pair[1].poll() is not None]:
                running.remove((job, process))
                if job.state() is JobState.done:
                    notify(job, "done")
                else:
                    failed[job.run] = why_failed(job.log, process.returncode)
                    notify(job, f"failed: {failed[job.run]}")
                if follow:
                    sort(follow(job, failed.get(job.run)))
    finally:
        for _, process in running:
            process.terminate()
        for _, process in running:
            process.wait()
    return failed


def _jobs(running: Sequence[Running]) -> list[Job]:
    return [job for job, _ in running]


def _stop(running: Sequence[Running], notify: Report) -> None:
    for job, process in running:
        process.terminate()
        notify(job, "stopped")


def _start(job: Job, threads: int, workers: int) -> subprocess.Popen[bytes]:
    job.log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | dict.fromkeys(THREADS, str(threads))
    numbers = (str(workers), str(os.getpid()))
    command = [sys.executable, "-m", job.worker, job.dump(), *numbers]
    with job.log.open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)


def why_failed(log: Path, code: int) -> str:
    """The error at the end of a job's log: what follows "error: ", else the last line."""
    if code < 0:
        return f"ended by signal {-code}"
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    marked = [i for i, line in enumerate(lines) if line.startswith("error: ")]
    if marked:
        return " ".join(lines[marked[-1] :]).removeprefix("error: ")
    return lines[-1].strip() if lines else f"exit code {code}, and an empty log"
