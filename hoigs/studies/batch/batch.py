"""`batch` and `work`: the command `hoigs batch`, and a worker for it, as Python functions."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.whole_files import write_whole
from hoigs.studies.batch.drive import Report, Work, drive
from hoigs.studies.batch.manifest import Row, read_manifest
from hoigs.studies.batch.stages import folder_of, stages_of
from hoigs.studies.batch.states import State
from hoigs.studies.batch.summary import write_summary
from hoigs.studies.execution.executor import Executor, make_executor

BATCH = "batch.json"


@dataclass(frozen=True)
class Batch:
    """What a batch has made.

    Attributes:
        rows: all rows that were chosen. failed: error of each row that failed, by name.
        summary: its files; empty with `dry_run`. plan: commands that are to run, by row.
    """

    rows: tuple[Row, ...]
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
    out = Path(out).absolute()
    rows = read_manifest(Path(manifest), defaults)
    chosen = [row for row in rows if not only_failed or State.known(folder_of(out, row)).failed]
    chosen = chosen[:limit]
    plan = {row.name: _plan(row, out) for row in chosen}
    if dry_run:
        return Batch(tuple(chosen), {}, (), plan)
    if out.exists() and not out.is_dir():
        raise HoigsError(f"{out}: is a file; --out names a folder")
    (out / "rows").mkdir(parents=True, exist_ok=True)
    write_whole(out / BATCH, json.dumps([row.model_dump(mode="json") for row in rows], indent=1))
    if isinstance(executor, str):
        executor = make_executor(executor, jobs, threads, address)
    failed = drive(chosen, out, executor, retries=retries, report=report, tick=tick)
    return Batch(tuple(chosen), failed, tuple(write_summary(rows, out)), plan)


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
    out = Path(out).absolute()
    try:
        rows = [Row.model_validate(row) for row in json.loads((out / BATCH).read_text())]
    except FileNotFoundError:
        raise HoigsError(
            f"{out}: no batch; `hoigs batch MANIFEST --out {out}` begins one"
        ) from None
    except ValueError as error:
        raise HoigsError(f"{out / BATCH}: damaged; `hoigs batch` writes it again") from error
    if isinstance(executor, str):
        executor = make_executor(executor, jobs, threads, address)
    failed = drive(rows, out, executor, retries=retries, report=report, tick=tick)
    return Batch(tuple(rows), failed, tuple(write_summary(rows, out)), {})


def _plan(row: Row, out: Path) -> list[str]:
    state = State.known(folder_of(out, row))
    return [" ".join(("hoigs", *state.command(s))) for s in state.todo(stages_of(row, out))]
