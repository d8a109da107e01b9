"""Queue: the tasks of a study or a batch, several at a time, each in a thread of its own.

Any number of drivers may work on the same tasks, on one machine or on many: a lock (`hold`) admits
one of them to a task, and what is done is what lies on disk. What computes are processes, which an
executor starts and which end with their driver or with its lock, even where the driver is killed.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TypeVar

from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.execution.local import Executor, Needs, Process

POLL_S = 0.02
TAKEN_POLL_S = 2.0  # how often a task that another driver has is looked at again
LEASE_POLL_S = 1.0

Task = TypeVar("Task")


class TakenError(HoigsError):
    """Another driver has this task or file."""


class StoppedError(Exception):
    """The queue ends: the time is over, or its caller was interrupted."""


@contextlib.contextmanager
def hold(folder: Path, work: str) -> Iterator[FolderLock]:
    """The lock that admits one driver to a task.

    Raises:
        TakenError: another driver has it.
    """
    lock = FolderLock(folder, work, TakenError).acquire()
    try:
        yield lock
    finally:
        with contextlib.suppress(OSError):
            lock.release()


class Queue:
    """Works on tasks, as many at a time as the executor has slots."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._stop, self._starting = threading.Event(), threading.Lock()

    def drain(
        self,
        take: Callable[[], Task | None],
        work: Callable[[Task], bool],
        *,
        ended: Callable[[Task], None] = lambda task: None,
        tick: Callable[[Sequence[Task]], None] = lambda running: None,
        limit_s: float | None = None,
    ) -> list[Task]:
        """Work on tasks until there are none. An interrupt, or an error of `work`, ends all.

        Args:
            take: the next task; None if there is none now.
            work: called in a thread; False if another driver has the task, which is then tried
                again later.
            ended: called with each task that is not another driver's any more.
            tick: called at every look, with the tasks that are worked on.
            limit_s: stop after this many seconds.

        Returns:
            The tasks that were begun, and stopped by the limit.
        """
        deadline = None if limit_s is None else time.monotonic() + limit_s
        waiting: list[tuple[float, Task]] = []  # of other drivers, and when to look again
        running: dict[Future[bool], Task] = {}

        def following() -> Task | None:
            for i, (due, task) in enumerate(waiting):
                if due <= time.monotonic():
                    waiting.pop(i)
                    return task
            return take()

        with ThreadPoolExecutor(self._executor.slots) as pool:
            try:
                while deadline is None or time.monotonic() <= deadline:
                    while len(running) < self._executor.slots and (task := following()) is not None:
                        running[pool.submit(work, task)] = task
                    if not running:
                        if not waiting:
                            return []
                        time.sleep(POLL_S)
                    for future in wait(running, POLL_S, FIRST_COMPLETED).done:
                        task = running.pop(future)
                        if future.result():
                            ended(task)
                        else:
                            waiting.append((time.monotonic() + TAKEN_POLL_S, task))
                    tick(list(running.values()))
                return [*running.values(), *(task for _, task in waiting)]
            finally:
                self._stop.set()

    def pause(self, seconds: float) -> None:
        """Sleep, within `work`.

        Raises:
            StoppedError: the queue ends.
        """
        if self._stop.wait(seconds):
            raise StoppedError

    def run(
        self,
        command: Sequence[str],
        log: Path,
        needs: Needs,
        lock: FolderLock,
        started: Callable[[Process], None] = lambda process: None,
    ) -> tuple[int, Process]:
        """The exit code of a process, within `work`, and the process; waits while all is busy.

        Args:
            command, log, needs: as for `Executor.start`. lock: of the task.
            started: called with the process once it runs.

        Raises:
            TakenError: another driver has taken the task over. StoppedError: the queue ends. The
                process is stopped then, and whatever else is raised.
        """
        process = None
        try:
            while process is None:
                self.pause(0.0)
                with self._starting:
                    process = self._executor.start(command, log, needs, lock.lease)
                if process is None:
                    self.pause(POLL_S)
            started(process)
            look_at = time.monotonic() + LEASE_POLL_S
            while (code := process.poll()) is None:
                self.pause(POLL_S)
                if time.monotonic() >= look_at:
                    look_at = time.monotonic() + LEASE_POLL_S
                    if lock.is_lost():
                        lock.require_held()
            lock.require_held()  # or another driver's record would be overwritten
            return code, process
        except BaseException:
            if process is not None:
                process.stop()
            raise
