"""`hoigs batch` and `hoigs work`: many videos or clips, on any number of machines."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hoigs.cli.common import AddressOption, ExecutorOption, JobsOption, ThreadsOption
from hoigs.core.names import printable

if TYPE_CHECKING:
    from hoigs.studies.batch.batch import Batch
    from hoigs.studies.batch.drive import Work

RetriesOption = Annotated[
    int, typer.Option("--retries", min=0, help="Further attempts at stages of a row that fail.")
]
LAST = 8  # ended rows that the live table shows


def batch(
    manifest: Annotated[
        Path, typer.Argument(help="YAML or CSV: one row a video or clip, with its settings.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the rows and the summary.")],
    spec: Annotated[
        str | None, typer.Option("--spec", help="Spec of rows that name none; default hoigs.")
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto", help="As for `hoigs train`, for rows that do not set it.")
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Keys of the spec for rows without `set`. Repeatable."),
    ] = None,
    export: Annotated[
        list[str] | None,
        typer.Option("--export", help="Format for rows without `export`; default ply. Repeatable."),
    ] = None,
    device: Annotated[
        str | None, typer.Option("--device", help="cpu, cuda or auto, for rows that name none.")
    ] = None,
    jobs: JobsOption = 1,
    threads: ThreadsOption = None,
    executor: ExecutorOption = "local",
    address: AddressOption = None,
    retries: RetriesOption = 1,
    limit: Annotated[
        int | None, typer.Option("--limit", min=1, help="Only this many rows, the first.")
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", help="failed: only rows whose last attempt failed.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the manifest and print what would run.")
    ] = False,
) -> None:
    """Prepare, train, evaluate and export every row of a manifest.

    The same command continues where it was stopped, stage by stage. A row that fails does not stop
    the others, and keeps its logs. Exit code 1: some rows failed.
    """
    from hoigs.core.errors import HoigsError
    from hoigs.studies.batch.batch import batch as run

    if only not in (None, "failed"):
        raise HoigsError(f'--only {only}: expected "failed"')
    given = {
        "spec": spec,
        "auto": auto or None,
        "set": settings,
        "export": export,
        "device": device,
    }
    defaults = {key: value for key, value in given.items() if value is not None}
    with _shown() as show:
        done = run(
            manifest, out, defaults=defaults, jobs=jobs, threads=threads, executor=executor,
            address=address, retries=retries, limit=limit, only_failed=only == "failed",
            dry_run=dry_run, **show,
        )  # fmt: skip
    if dry_run:
        for name, commands in done.plan.items():
            typer.echo(f"{name}:" + ("".join(f"\n  {c}" for c in commands) or " done"))
        return
    _finish(done)


def work(
    out: Annotated[Path, typer.Argument(help="Folder that `hoigs batch` was given as --out.")],
    jobs: JobsOption = 1,
    threads: ThreadsOption = None,
    executor: ExecutorOption = "local",
    address: AddressOption = None,
    retries: RetriesOption = 1,
) -> None:
    """Help with a batch: work on its rows that nobody works on, until none is left."""
    from hoigs.studies.batch.batch import work as run

    with _shown() as show:
        done = run(
            out, jobs=jobs, threads=threads, executor=executor, address=address, retries=retries,
            **show,
        )  # fmt: skip
    _finish(done)


def _finish(done: Batch) -> None:
    for path in done.summary:
        typer.echo(f"wrote {path}")
    if done.failed:
        typer.echo(f"{len(done.failed)} of {done.rows} rows failed", err=True)
        raise typer.Exit(1)


@contextmanager
def _shown() -> Iterator[dict[str, Any]]:
    """`report` and `tick`: a live table on a terminal, else a line for each event."""
    from rich.console import Console
    from rich.live import Live

    console, table = Console(), _LiveTable()
    if not console.is_terminal:
        yield {"report": lambda work, word: typer.echo(printable(f"{work.row.name}: {word}"))}
        return
    with Live(console=console, get_renderable=table.draw, refresh_per_second=4):
        yield {"report": table.report, "tick": table.tick}


class _LiveTable:
    """Rows that run, and the last that ended."""

    def __init__(self) -> None:
        self.running: Sequence[Work] = ()
        self.ended: dict[str, str] = {}
        self.times: list[float] = []  # seconds of each row that this driver has finished

    def report(self, work: Work, word: str) -> None:
        ended = word in ("done", "done before") or word.startswith("failed")
        if ended:
            self.ended[work.row.name] = word
        if word == "done":
            self.times.append(time.monotonic() - work.taken_at)

    def tick(self, running: Sequence[Work]) -> None:
        self.running = list(running)

    def draw(self) -> Any:
        from rich.markup import escape
        from rich.table import Table

        failed = sum(word.startswith("failed") for word in self.ended.values())
        table = Table(title=f"{len(self.ended)} rows ended, {failed} failed", title_justify="left")
        for column in ("row", "stage", "seconds", "ETA", "device", "retries"):
            table.add_column(column)
        for name, word in list(self.ended.items())[-LAST:]:
            table.add_row(escape(printable(name)), escape(printable(word)), "", "", "", "")
        now = time.monotonic()
        for work in self.running:
            seconds = f"{now - work.since:.0f}" if work.process else ""
            table.add_row(
                escape(printable(work.row.name)), escape(work.stage), seconds, self._eta(work, now),
                work.device, str(work.retries),
            )  # fmt: skip
        return table

    def _eta(self, work: Work, now: float) -> str:
        """Of a row, by the mean time of the rows that this driver has finished."""
        if not self.times:
            return ""
        mean = sum(self.times) / len(self.times)
        return f"{max(0.0, mean - (now - work.taken_at)):.0f} s"
