"""run_jobs: the jobs of a study that are not done, several at a time, each in its own process."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.execution.local import LOST_RETRIES, Executor, LocalExecutor, Needs, why_failed
from hoigs.studies.execution.queue import Queue, TakenError, hold
from hoigs.studies.jobs.job import Job, JobState

OUT_OF_TIME = "the time limit came first; run the same command again"

Report = Callable[[Job, str], None]
Follow = Callable[[Job, str | None], Sequence[Job]]


def run_jobs(
    jobs: Sequence[Job],
    executor: Executor | None = None,
    *,
    limit_s: float | None = None,
    report: Report | None = None,
    follow: Follow | None = None,
) -> Mapping[str, str]:
    """Run the jobs that are not done; a job that fails does not stop the others.

    Args:
        executor: where they run; default this machine, one at a time.
        limit_s: stop after this many seconds; the next call continues.
        report: called with a job and "done before", "started", "done", "stopped", "taken by another
            driver", or "failed: why".
        follow: called with each job that has ended, and the error if it failed; the jobs that it
            returns are run too, before those that wait.

    Returns:
        The error of each job that failed, by run folder; all others are done. An interrupt
        ends the processes; the next call continues from their last checkpoints.
    """
    own = _Jobs(executor or LocalExecutor(), report or (lambda job, word: None), follow)
    own.add(jobs)
    begun = own.queue.drain(own.take, own.work, ended=own.ended, limit_s=limit_s)
    for job in begun:
        if job.run not in own.taken:
            own.notify(job, "stopped")
    return own.failed | dict.fromkeys((job.run for job in (*begun, *own.waiting)), OUT_OF_TIME)


class _Jobs:
    def __init__(self, executor: Executor, report: Report, follow: Follow | None) -> None:
        self.queue, self._slots = Queue(executor), executor.slots
        self._report, self._follow, self._reporting = report, follow, threading.Lock()
        self.waiting: deque[Job] = deque()
        self.failed: dict[str, str] = {}
        self.taken: set[str] = set()  # runs of the jobs that other drivers have

    def notify(self, job: Job, word: str) -> None:
        with self._reporting:
            self._report(job, word)

    def add(self, found: Iterable[Job]) -> None:
        """Queue jobs before the others; those that are done are replaced by what follows them."""
        todo, late = deque(found), []
        while todo:
            job = todo.popleft()
            if job.state() is JobState.done:
                self.notify(job, "done before")
                todo.extend(self._follow(job, None) if self._follow else ())
            else:
                late.append(job)
        self.waiting.extendleft(reversed(late))

    def take(self) -> Job | None:
        return self.waiting.popleft() if self.waiting else None

    def work(self, job: Job) -> bool:
        """Run a job; False if another driver has it."""
        try:
            with hold(job.lease, "a job of a study") as lock:
                if job.state() is JobState.done:  # by another driver, before its lock was ours
                    self.notify(job, "done before")
                    return True
                if left := FolderLock(job.folder, "").holder():  # by a driver that was lost
                    raise TakenError(left)
                self.taken.discard(job.run)
                job.log.unlink(missing_ok=True)
                command = (job.worker, job.dump(), str(self._slots))
                needs = Needs(gpus=0.0 if job.device == "cpu" else None, retries=LOST_RETRIES)
                code, _ = self.queue.run(
                    command, job.log, needs, lock, lambda process: self.notify(job, "started")
                )
        except TakenError:
            if job.run not in self.taken:
                self.taken.add(job.run)
                self.notify(job, "taken by another driver")
            return False
        if job.state() is JobState.done:
            self.notify(job, "done")
        else:
            self.failed[job.run] = why_failed(job.log, code)
            self.notify(job, f"failed: {self.failed[job.run]}")
        return True

    def ended(self, job: Job) -> None:
        if self._follow:
            self.add(self._follow(job, self.failed.get(job.run)))
