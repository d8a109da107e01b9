"""run_jobs: the jobs of a study that are not done, several at a time, each in its own process.

Any number of drivers may work on one study, on one machine or on many: a lock beside each run
folder admits one of them to a job, and what is done is what lies on disk.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.execution.local import (
    LOST_RETRIES,
    Executor,
    LocalExecutor,
    Needs,
    Process,
    stop_all,
    why_failed,
)
from hoigs.studies.jobs.job import Job, JobState

POLL_S = 0.05
TAKEN_POLL_S = 2.0  # how often a job that another driver has is looked at again
LEASE_POLL_S = 1.0

OUT_OF_TIME = "the time limit came first; run the same command again"

Report = Callable[[Job, str], None]
Follow = Callable[[Job, str | None], Sequence[Job]]


class TakenError(HoigsError):
    """Another driver has this job."""


@dataclass
class _Running:
    job: Job
    lock: FolderLock
    process: Process
    look_at: float  # when to look at the lock again


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
    deadline = None if limit_s is None else time.monotonic() + limit_s
    own = _Jobs(executor or LocalExecutor(), report or (lambda job, word: None), follow)
    own.add(jobs)
    try:
        while own.waiting or own.running:
            if deadline is not None and time.monotonic() > deadline:
                return own.failed | dict.fromkeys(own.stopped(), OUT_OF_TIME)
            own.start()
            time.sleep(POLL_S)
            for running in list(own.running):
                own.look(running)
    finally:
        own.end()
    return own.failed


@dataclass
class _Jobs:
    executor: Executor
    notify: Report
    follow: Follow | None
    waiting: deque[Job] = field(default_factory=deque)
    running: list[_Running] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    not_before: dict[str, float] = field(default_factory=dict)  # of jobs that others have, by run
    full: bool = False  # whether the executor had no room, and nothing has ended since

    def add(self, found: Iterable[Job]) -> None:
        """Queue jobs before the others; those that are done are replaced by what follows them."""
        todo = deque(found)
        late: list[Job] = []
        while todo:
            job = todo.popleft()
            if job.state() is JobState.done:
                self.notify(job, "done before")
                todo.extend(self.follow(job, None) if self.follow else ())
            else:
                late.append(job)
        self.waiting.extendleft(reversed(late))

    def start(self) -> None:
        """Start what the executor has room for and no other driver has."""
        for _ in range(len(self.waiting)):
            if len(self.running) >= self.executor.slots or (self.full and self.running):
                return
            job = self.waiting.popleft()
            if time.monotonic() < self.not_before.get(job.run, 0.0) or not self._start(job):
                self.waiting.append(job)

    def _start(self, job: Job) -> bool:
        """Whether the job has left the queue."""
        lock = FolderLock(job.lease, "a job of a study", TakenError)
        try:
            lock.acquire()
        except TakenError:
            return self._taken(job)
        try:
            if job.state() is JobState.done:  # by another driver, before its lock was ours
                lock.release()
                self.add([job])
                return True
            if FolderLock(job.folder, "").holder():  # what a driver that was lost left running
                lock.release()
                return self._taken(job)
            job.log.unlink(missing_ok=True)
            command = (job.worker, job.dump(), str(self.executor.slots))
            needs = Needs(gpus=0.0 if job.device == "cpu" else None, retries=LOST_RETRIES)
            process = self.executor.start(command, job.log, needs, lock.lease)
        except BaseException:
            lock.release()
            raise
        self.full = process is None
        if process is None:
            lock.release()
            return False
        self.not_before.pop(job.run, None)
        self.notify(job, "started")
        self.running.append(_Running(job, lock, process, time.monotonic() + LEASE_POLL_S))
        return True

    def _taken(self, job: Job) -> bool:
        if job.run not in self.not_before:
            self.notify(job, "taken by another driver")
        self.not_before[job.run] = time.monotonic() + TAKEN_POLL_S
        return False

    def look(self, running: _Running) -> None:
        """See whether a job has ended, or is another driver's by now."""
        job, code = running.job, running.process.poll()
        if code is None and time.monotonic() < running.look_at:
            return
        running.look_at = time.monotonic() + LEASE_POLL_S
        if running.lock.is_lost():
            running.process.stop()
            self._remove(running)
            self._taken(job)
            self.waiting.append(job)
            return
        if code is None:
            return
        self._remove(running)
        running.lock.release()
        if job.state() is JobState.done:
            self.notify(job, "done")
        else:
            self.failed[job.run] = why_failed(job.log, code)
            self.notify(job, f"failed: {self.failed[job.run]}")
        if self.follow:
            self.add(self.follow(job, self.failed.get(job.run)))

    def _remove(self, running: _Running) -> None:
        self.running.remove(running)
        self.full = False

    def stopped(self) -> list[str]:
        """Stop all; the runs of the jobs that are not done."""
        rest = [*self.waiting, *(r.job for r in self.running)]
        for running in self.running:
            self.notify(running.job, "stopped")
        self.end()
        return [job.run for job in rest]

    def end(self) -> None:
        stop_all(running.process for running in self.running)
        for running in self.running:
            running.lock.release()
        self.running.clear()
