"""`batch` and `work`: the command `hoigs batch`, and a worker for it, as Python functions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from hoigs.studies.batch.drive import Report, Work, drive
from hoigs.studies.batch.folder import BATCH, BatchFolder
from hoigs.studies.batch.manifest import Row, each_row
from hoigs.studies.batch.stages import stages_of
from hoigs.studies.batch.states import State
from hoigs.studies.batch.summary import write_summary
from hoigs.studies.execution.executor import Executor, make_executor


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
        report, tick: as for `hoigs.studies.batch.drive.drive`.

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
