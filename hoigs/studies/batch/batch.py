"""`batch` and `work`: the command `hoigs batch`, and a worker for it, as Python functions."""

from __future__ import annotations

import contextlib
import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.batch.folder import BATCH, BatchFolder, Stage, State, TakenError, stages_of
from hoigs.studies.batch.manifest import Row, each_row
from hoigs.studies.batch.summary import write_summary
from hoigs.studies.execution.local import (
    LOST_RETRIES,
    Executor,
    Needs,
    Process,
    make_executor,
    stop_all,
    why_failed,
)

# The driver of a batch: runs the stages of rows that no other driver works on.
#
# Any number of drivers may work on one folder, on one machine or on many: the lock of a row's
# folder (`hoigs.core.system.folder_lock`) admits one of them, and what is done is what lies on
# disk.

POLL_S = 0.01
TAKEN_POLL_S = 2.0  # how often a row that another driver has is looked at again
RETRY_S = 1.0
LEASE_POLL_S = 1.0
NEW_ROWS = 100  # that are looked at between two looks at the running ones
WRONG_INPUT = 2  # exit code that another attempt does not change
Report = Callable[["Work", str], None]


@dataclass
class Work:
    """A row in this driver's hands.

    Attributes:
        stage: that runs, or ran last. since: when it was started, on the monotonic clock.
        taken_at: when this driver took the row.
        retries: of the present stage, by this driver, and losses: those of them whose machine was
            lost. device: where the stage runs.
    """

    row: Row
    folder: Path
    stages: list[Stage]
    state: State = field(default_factory=State)
    stage: str = ""
    since: float = 0.0
    taken_at: float = 0.0
    retries: int = 0
    losses: int = 0
    device: str = ""
    lock: FolderLock | None = None
    process: Process | None = None
    not_before: float = 0.0
    look_at: float = 0.0  # when to look at the lock again

    @property
    def todo(self) -> Sequence[Stage]:
        return self.state.todo(self.stages)

    @property
    def log(self) -> Path:
        return self.folder / f"{self.stage}.log"


def drive(
    rows: Iterable[Row],
    out: BatchFolder,
    executor: Executor,
    *,
    retries: int = 1,
    report: Report = lambda work, word: None,
    tick: Callable[[Sequence[Work]], None] = lambda running: None,
) -> dict[str, str]:
    """Run all that is not done; returns the error of each row that failed, by name.

    Rows that another driver has are waited for, and taken over if it dies. A row that failed before
    is tried again, unless that was after this call began. An interrupt ends the processes; the next
    call continues.

    Args:
        rows: taken one by one, as there is room.
        retries: further attempts at a stage that failed.
        report: called with a row and "done before", "taken by another driver", "STAGE", "STAGE
            done", "waits: why", "retry: why", "done" or "failed: why".
        tick: called at every look at the running rows.
    """
    began = time.time()
    new = (Work(row, out.of(row), stages_of(row, out.of(row))) for row in rows)
    waiting: deque[Work] = deque()  # rows that other drivers have
    more = True
    running: list[Work] = []
    failed: dict[str, str] = {}
    driver = _Driver(executor, retries, report, began, failed)
    try:
        while more or waiting or running:
            for i in range(len(waiting) + NEW_ROWS):
                if len(running) >= executor.slots:
                    break
                known = i < len(waiting)
                work = waiting.popleft() if known else next(new, None)
                if work is None:
                    more = False
                    break
                if time.monotonic() < work.not_before or (taken := driver.take(work)) is None:
                    waiting.append(work)
                elif taken:
                    running.append(work)
            running = [work for work in running if driver.go_on(work)]
            waiting.extend(driver.lost)
            driver.lost.clear()
            tick(running)
            time.sleep(POLL_S)
    finally:
        stop_all(work.process for work in running)
        for work in running:
            if work.lock is not None:
                work.lock.release()
    return failed


@dataclass
class _Driver:
    executor: Executor
    retries: int
    report: Report
    began: float
    failed: dict[str, str]
    lost: list[Work] = field(default_factory=list)  # rows that another driver took over

    def take(self, work: Work) -> bool | None:
        """Whether this driver works on the row now; None if another one does."""
        if self._settled(work):
            return False
        lock = FolderLock(work.folder, "hoigs batch", error=TakenError)
        try:
            lock.acquire()
        except TakenError:
            if not work.not_before:
                self.report(work, "taken by another driver")
            work.not_before = time.monotonic() + TAKEN_POLL_S
            return None
        if self._settled(work):  # by another driver, before its lock was ours
            lock.release()
            return False
        work.lock = lock
        work.not_before, work.taken_at = 0.0, time.monotonic()
        work.folder.mkdir(exist_ok=True)
        return True

    def _settled(self, work: Work) -> bool:
        """Whether nothing is to be done for a row."""
        try:
            work.state = State.read(work.folder)
        except HoigsError as error:
            return self._failed(work, str(error))
        if not work.todo:
            self.report(work, "done before")
            return True
        if work.state.failed.when > self.began:
            return self._failed(work, work.state.failed.why)
        return False

    def _failed(self, work: Work, why: str) -> bool:
        self.failed[work.row.name] = why
        self.report(work, f"failed: {why}")
        return True

    def go_on(self, work: Work) -> bool:
        """Look at a row; whether it is still worked on."""
        try:
            return self._go_on(work)
        except (HoigsError, OSError) as error:  # costs this row only
            if work.process is not None:
                work.process.stop()
                work.process = None
            if isinstance(error, TakenError):
                self.report(work, "taken over by another driver")
                work.lock, work.not_before = None, time.monotonic() + TAKEN_POLL_S
                self.lost.append(work)
                return False
            with contextlib.suppress(OSError):  # a full disk, say, which is the error itself
                work.state.fail(work.todo[0], str(error))
                work.state.write(work.folder)
            self._failed(work, str(error))
            return self._leave(work)

    def _go_on(self, work: Work) -> bool:
        if work.process is None:
            self._start(work)
            return True
        assert work.lock is not None
        code = work.process.poll()
        if code is None:
            if time.monotonic() >= work.look_at:
                work.look_at = time.monotonic() + LEASE_POLL_S
                if work.lock.is_lost():
                    work.lock.require_held()
            return True
        work.lock.require_held()  # or another driver's record would be overwritten
        lost = work.process.lost and work.losses < LOST_RETRIES
        work.device = work.process.device  # some executors know it only now
        stage, work.process = work.todo[0], None
        if code == 0 and stage.result.exists():
            seconds = time.monotonic() - work.since
            work.state.end(stage, seconds, work.device, socket.gethostname())
            work.state.write(work.folder)
            work.retries = work.losses = 0
            self.report(work, f"{stage.name} done")
            if work.todo:
                self._start(work)
                return True
            self.report(work, "done")
            return self._leave(work)
        why = why_failed(work.log, code) if code else f"made no {stage.result.name}"
        if lost or (code != WRONG_INPUT and work.retries - work.losses < self.retries):
            work.retries, work.losses = work.retries + 1, work.losses + lost
            work.not_before = time.monotonic() + RETRY_S
            self.report(work, f"retry: {why}")
            return True
        work.state.fail(stage, why)
        work.state.write(work.folder)
        self._failed(work, why)
        return self._leave(work)

    def _start(self, work: Work) -> None:
        """Start the next stage of a row, unless all is busy or a retry waits."""
        if time.monotonic() < work.not_before:
            return
        assert work.lock is not None
        work.lock.require_held()
        todo = work.todo
        stage = todo[0]
        command = work.state.command(stage)
        gpus = 0.0 if work.row.device == "cpu" else work.row.gpus
        needs = Needs(gpus=gpus, memory_gb=work.row.memory_gb)
        work.stage = stage.name
        if left := FolderLock(stage.locks, "").holder():  # by a driver that was lost
            self.report(work, f"waits: {stage.locks.name} is being written by {left}")
            work.not_before = time.monotonic() + TAKEN_POLL_S
            return
        if stage.clear and stage.result.exists():
            shutil.rmtree(stage.result)
        work.process = self.executor.start(("hoigs", *command), work.log, needs, work.lock.lease)
        if work.process is not None:
            work.since, work.device = time.monotonic(), work.process.device
            work.state.begin(todo)
            work.state.write(work.folder)
            self.report(work, stage.name)

    def _leave(self, work: Work) -> bool:
        if work.lock is not None:
            with contextlib.suppress(OSError):
                work.lock.release()
        work.process = None
        return False


@dataclass(frozen=True)
class Batch:
    """What a batch has made.

    Attributes:
        rows: how many were chosen. failed: error of each row that failed, by name.
        summary: its files; empty with `dry_run`. plan: with it, the commands that are to run, by
            row.
    """

    rows: int
    failed: Mapping[str, str]
    summary: tuple[Path, ...]
    plan: Mapping[str, Sequence[str]]


def batch(
    manifest: Path | str,
    out: Path | str,
    *,
    defaults: Mapping[str, Any] | None = None,
    jobs: int = 1,
    threads: int | None = None,
    retries: int = 1,
    limit: int | None = None,
    only_failed: bool = False,
    dry_run: bool = False,
    executor: Executor | str = "local",
    address: str | None = None,
    report: Report = lambda work, word: None,
    tick: Callable[[Sequence[Work]], None] = lambda running: None,
) -> Batch:
    """Prepare, train, evaluate and export every row of a manifest; the same call continues.

    Args:
        manifest: YAML or CSV; `hoigs.studies.batch.manifest.Row` has the keys of a row.
        out: folder of rows and summary. Several calls may work on it at once.
        defaults: keys for rows that have none.
        jobs: rows at a time. threads: of each; default cores / jobs. retries: of a failed stage.
        limit: only the first rows. only_failed: only rows whose last attempt failed.
        dry_run: run and write nothing.
        executor: where the stages run: "local", this machine and its GPUs in turn; "ray", all of a
            Ray cluster; "MODULE:CLASS"; or an Executor. address: of the cluster to join.
        report, tick: as for `hoigs.studies.batch.batch.drive`.

    Raises:
        HoigsError: the manifest or a folder cannot be used. A row that fails raises nothing.
    """
    path = Path(out).absolute()
    rows = each_row(Path(manifest), defaults)
    if dry_run:
        known = BatchFolder.open(path) if (path / BATCH).exists() else BatchFolder(path)
        chosen = islice(_chosen(rows, known, only_failed), limit)
        plan = {row.name: _plan(row, known.of(row)) for row in chosen}
        return Batch(len(plan), {}, (), plan)
    where = _executor(executor, jobs, threads, address)
    folder = BatchFolder.begin(path, rows)
    chosen = islice(_chosen(folder.rows(), folder, only_failed), limit)
    return _drive(folder, chosen, where, retries, report, tick)


def _chosen(rows: Iterable[Row], folder: BatchFolder, only_failed: bool) -> Iterator[Row]:
    return (row for row in rows if not only_failed or State.known(folder.of(row)).failed.why)


def work(
    out: Path | str,
    *,
    jobs: int = 1,
    threads: int | None = None,
    retries: int = 1,
    executor: Executor | str = "local",
    address: str | None = None,
    report: Report = lambda work, word: None,
    tick: Callable[[Sequence[Work]], None] = lambda running: None,
) -> Batch:
    """Work on the rows of a batch that was begun in `out`, until none is left.

    Any scheduler can start it, on any machine that has the folder and the inputs under the same
    paths. Arguments and errors as for `batch`.
    """
    folder = BatchFolder.open(Path(out).absolute())
    where = _executor(executor, jobs, threads, address)
    return _drive(folder, folder.rows(), where, retries, report, tick)


def _executor(
    given: Executor | str, jobs: int, threads: int | None, address: str | None
) -> Executor:
    return make_executor(given, jobs, threads, address) if isinstance(given, str) else given


def _drive(
    folder: BatchFolder,
    rows: Iterable[Row],
    executor: Executor,
    retries: int,
    report: Report,
    tick: Callable[[Sequence[Work]], None],
) -> Batch:
    count = 0

    def counted() -> Iterator[Row]:
        nonlocal count
        for row in rows:
            count += 1
            yield row

    failed = drive(counted(), folder, executor, retries=retries, report=report, tick=tick)
    return Batch(count, failed, tuple(write_summary(folder)), {})


def _plan(row: Row, folder: Path) -> list[str]:
    state = State.known(folder)
    return [" ".join(("hoigs", *state.command(s))) for s in state.todo(stages_of(row, folder))]
