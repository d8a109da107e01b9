"""`batch` and `work`: the command `hoigs batch`, and a worker for it, as Python functions."""

from __future__ import annotations

import contextlib
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.options import verb
from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.batch.folder import BATCH, BatchFolder, Stage, State, stages_of
from hoigs.studies.batch.manifest import Row, each_row
from hoigs.studies.batch.summary import write_summary
from hoigs.studies.execution.local import LOST_RETRIES, Executor, Needs, Process, why_failed
from hoigs.studies.execution.queue import TAKEN_POLL_S, Queue, TakenError, hold
from hoigs.studies.options import BatchOptions, WorkOptions

RETRY_S = 1.0
WRONG_INPUT = 2  # exit code that another attempt does not change
Report = Callable[["Work", str], None]


@dataclass
class Work:
    """A row in this driver's hands.

    Attributes:
        stage: that runs, or ran last. since: when it was started, on the monotonic clock.
        taken_at: when this driver took the row. process: of the stage, while it runs.
        retries: of the present stage, by this driver. device: where the stage runs.
    """

    row: Row
    folder: Path
    stages: list[Stage]
    state: State = field(default_factory=State)
    stage: str = ""
    since: float = 0.0
    taken_at: float = 0.0
    retries: int = 0
    device: str = ""
    process: Process | None = None
    elsewhere: bool = False  # whether another driver has it

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
        tick: called at every poll of the running rows.
    """
    new = (Work(row, out.of(row), stages_of(row, out.of(row))) for row in rows)
    driver = _Driver(Queue(executor), retries, report)
    driver.queue.drain(lambda: next(new, None), driver.work, tick=tick)
    return driver.failed


class _Driver:
    def __init__(self, queue: Queue, retries: int, report: Report) -> None:
        self.queue, self._retries = queue, retries
        self._report, self._reporting = report, threading.Lock()
        self._began = time.time()
        self.failed: dict[str, str] = {}

    def report(self, work: Work, word: str) -> None:
        with self._reporting:
            self._report(work, word)

    def work(self, work: Work) -> bool:
        """Run the stages of a row that are not done; False if another driver has it."""
        if self._settled(work):
            return True
        try:
            with hold(work.folder, "hoigs batch") as lock:
                work.elsewhere, work.taken_at = False, time.monotonic()
                if not self._settled(work):  # by another driver, before its lock was ours
                    work.folder.mkdir(exist_ok=True)
                    self._stages(work, lock)
        except TakenError:
            if not work.elsewhere:
                self.report(work, "taken by another driver")
            work.elsewhere = True
            return False
        finally:
            work.process = None
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
        if work.state.failed.when > self._began:
            return self._failed(work, work.state.failed.why)
        return False

    def _failed(self, work: Work, why: str) -> bool:
        self.failed[work.row.name] = why
        self.report(work, f"failed: {why}")
        return True

    def _stages(self, work: Work, lock: FolderLock) -> None:
        why = ""
        try:
            while work.todo and not why:
                why = self._stage(work, lock)
        except TakenError:
            raise
        except (HoigsError, OSError) as error:  # costs this row only
            why = str(error)
        if not why:
            self.report(work, "done")
            return
        with contextlib.suppress(OSError):  # a full disk, say, which is the error itself
            work.state.fail(work.todo[0], why)
            work.state.write(work.folder)
        self._failed(work, why)

    def _stage(self, work: Work, lock: FolderLock) -> str:
        """Run the next stage of a row; why it failed, or an empty text."""
        todo = work.todo
        stage, work.stage, work.retries, losses = todo[0], todo[0].name, 0, 0
        gpus = 0.0 if work.row.device == "cpu" else work.row.gpus
        needs = Needs(gpus=gpus, memory_gb=work.row.memory_gb)

        def started(process: Process) -> None:
            work.process, work.since, work.device = process, time.monotonic(), process.device
            work.state.begin(todo)
            work.state.write(work.folder)
            self.report(work, stage.name)

        while True:
            while left := FolderLock(stage.locks, "").holder():  # by a driver that was lost
                self.report(work, f"waits: {stage.locks.name} is being written by {left}")
                self.queue.pause(TAKEN_POLL_S)
            lock.require_held()
            command = ("hoigs", *work.state.command(stage))
            if stage.clear and stage.result.exists():
                shutil.rmtree(stage.result)
            code, process = self.queue.run(command, work.log, needs, lock, started)
            work.process, work.device = None, process.device  # some executors know it only now
            if code == 0 and stage.result.exists():
                seconds = time.monotonic() - work.since
                work.state.end(stage, seconds, work.device, socket.gethostname())
                work.state.write(work.folder)
                self.report(work, f"{stage.name} done")
                return ""
            why = why_failed(work.log, code) if code else f"made no {stage.result.name}"
            lost = process.lost and losses < LOST_RETRIES
            if not lost and (code == WRONG_INPUT or work.retries - losses >= self._retries):
                return why
            work.retries, losses = work.retries + 1, losses + lost
            self.report(work, f"retry: {why}")
            self.queue.pause(RETRY_S)


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


@verb(BatchOptions)
def batch(
    manifest: Path | str,
    out: Path | str,
    *,
    options: BatchOptions,
    report: Report = lambda work, word: None,
    tick: Callable[[Sequence[Work]], None] = lambda running: None,
) -> Batch:
    """Prepare, train, evaluate and export every row of a manifest; the same call continues.

    Args:
        manifest: YAML or CSV; `hoigs.studies.batch.manifest.Row` has the keys of a row.
        out: folder of rows and summary. Several calls may work on it at once.
        report, tick: as for `hoigs.studies.batch.batch.drive`.

    Raises:
        HoigsError: the manifest or a folder cannot be used. A row that fails raises nothing.
    """
    if options.only not in (None, "failed"):
        raise HoigsError(f'--only {options.only}: expected "failed"')
    path = Path(out).absolute()
    rows = each_row(Path(manifest), options.defaults())
    if options.dry_run:
        known = BatchFolder.open(path) if (path / BATCH).exists() else BatchFolder(path)
        chosen = islice(_chosen(rows, known, options), options.limit)
        plan = {row.name: _plan(row, known.of(row)) for row in chosen}
        return Batch(len(plan), {}, (), plan)
    where = options.place()
    folder = BatchFolder.begin(path, rows)
    chosen = islice(_chosen(folder.rows(), folder, options), options.limit)
    return _drive(folder, chosen, where, options.retries, report, tick)


def _chosen(rows: Iterable[Row], folder: BatchFolder, options: BatchOptions) -> Iterator[Row]:
    again = options.only == "failed"
    return (row for row in rows if not again or State.known(folder.of(row)).failed.why)


@verb(WorkOptions)
def work(
    out: Path | str,
    *,
    options: WorkOptions,
    report: Report = lambda work, word: None,
    tick: Callable[[Sequence[Work]], None] = lambda running: None,
) -> Batch:
    """Work on the rows of a batch that was begun in `out`, until none is left.

    Any scheduler can start it, on any machine that has the folder and the inputs under the same
    paths. Arguments and errors as for `batch`.
    """
    folder = BatchFolder.open(Path(out).absolute())
    return _drive(folder, folder.rows(), options.place(), options.retries, report, tick)


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
