"""Options, tables and progress bars that commands share; imports no torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from hoigs.core.names import printable

SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Set one key of the spec: train.steps=500. Repeatable."),
]
RasterizerOption = Annotated[
    str | None,
    typer.Option("--rasterizer", help="Rasterizer: warp, torch, oracle or a plugin."),
]
DeviceOption = Annotated[
    str, typer.Option("--device", help="cpu, cuda, or auto: cuda if available.")
]
SeedsOption = Annotated[int, typer.Option("--seeds", min=1, help="Number of seeds: 0, 1 …")]
JobsOption = Annotated[int, typer.Option("--jobs", min=1, help="Trainings at a time.")]
ThreadsOption = Annotated[
    int | None,
    typer.Option("--threads", min=1, help="Threads of each training; default cores / jobs."),
]
ExecutorOption = Annotated[
    str,
    typer.Option(
        "--executor",
        help="Where they run: local, ray (pip install 'hoigs[ray]'), or MODULE:CLASS of your own.",
    ),
]
AddressOption = Annotated[
    str | None,
    typer.Option(
        "--address", help="Ray cluster to join: auto, HOST:PORT. Default: Ray on this machine only."
    ),
]
MinutesOption = Annotated[
    float | None,
    typer.Option(
        "--minutes",
        help="Stop after this time and write the results so far; the same command continues.",
    ),
]
ClipOption = Annotated[
    Path | None,
    typer.Option("--clip", help="The clip, if it was moved: a folder or builtin:NAME."),
]
AllowFaultsOption = Annotated[
    bool,
    typer.Option(
        "--allow-faults",
        help="Continue without masks, images and depth that are missing or broken.",
    ),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace what hoigs wrote to --out before.")
]
PluginOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugin", help="Also load this Python file as a plugin; its code runs. Repeatable."
    ),
]


def study_device(device: str, executor: str) -> str:
    """`pick_device`; a GPU for jobs on other machines need not be in this one."""
    from hoigs.runs.choices import pick_device

    return pick_device(device) if executor == "local" or device == "auto" else device


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    notes: Sequence[str] = (),
    *,
    widest: int | None = None,
) -> None:
    """Print a table on stdout; without rows its title and notes alone.

    No cell is cut: in a terminal that is too narrow lines break, between words where these fit;
    elsewhere lines are as long as they need to be, or as `widest` allows.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    cells = [[printable(str(cell)) for cell in row] for row in (columns, *rows)]
    widths, room = _widths(cells), 3 * len(columns) + 1  # of lines and spaces between columns
    if not console.is_terminal:
        console.width = widest or max(160, sum(most for _, most in widths) + room)
    table = Table(title=escape(printable(title)), title_justify="left")
    for i, width in enumerate(_shared(widths, console.width - room)):
        values = [row[i] for row in cells[1:] if row[i]]
        numbers = i > 0 and all(value.lstrip("+-")[:1].isdigit() for value in values)
        table.add_column(
            escape(cells[0][i]),
            justify="right" if numbers else "left",
            overflow="fold",
            width=width,
        )
    for row in cells[1:]:
        table.add_row(*map(escape, row))  # "hoigs[gsplat]" is no markup
    console.print(table if rows else f"[bold]{table.title}[/bold]", highlight=False)
    for note in notes:
        console.print(f"[dim]{escape(printable(note))}[/dim]", highlight=False)


def _widths(cells: Sequence[Sequence[str]]) -> list[tuple[int, int]]:
    """Of each column the width of its longest word, and of its longest line."""
    from rich.cells import cell_len

    found = []
    for column in zip(*cells, strict=True):
        lines = [line for cell in column for line in cell.split("\n")]
        words = [word for line in lines for word in line.split()]
        found.append((max(map(cell_len, words), default=0), max(map(cell_len, lines))))
    return found


def _shared(widths: Sequence[tuple[int, int]], space: int) -> list[int | None]:
    """The width of each column: that of its lines, or the same for all whose lines have to break,
    but never less than their words. None where not even words fit."""
    for limit in range(max((most for _, most in widths), default=0), 0, -1):
        shared = [max(least, min(most, limit)) for least, most in widths]
        if sum(shared) <= space:
            return list(shared)
    return [None] * len(widths)


class Bar:
    """One progress bar; `update(done, text)` from anywhere."""

    def __init__(self, progress: Any, task: Any) -> None:
        self._progress, self._task = progress, task

    def update(self, done: float, text: str = "") -> None:
        self._progress.update(self._task, completed=done, text=text)


@contextmanager
def progress_bar(title: str, total: float) -> Iterator[Bar]:
    """A bar with elapsed time and ETA on stderr; quiet when stderr is not a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    count = "{task.completed:.0f}/{task.total:.0f}" if total > 1 else "{task.percentage:.0f} %"
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn(count),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
        console=console,
        transient=False,
        disable=not console.is_terminal,
    ) as progress:
        yield Bar(progress, progress.add_task(title, total=total, text=""))
