"""What the verbs share: options, tables and progress bars. No torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override one key of the spec: train.steps=500. Repeatable."),
]
RasterizerOption = Annotated[
    str | None,
    typer.Option("--rasterizer", help="Backend: warp, torch, oracle or any rasterizer plugin."),
]
DeviceOption = Annotated[
    str, typer.Option("--device", help="cpu, cuda, or auto: cuda where there is one.")
]
SeedsOption = Annotated[int, typer.Option("--seeds", min=1, help="Runs of each, seeds 0, 1 …")]
JobsOption = Annotated[int, typer.Option("--jobs", min=1, help="Runs at a time.")]
ThreadsOption = Annotated[
    int | None, typer.Option("--threads", min=1, help="Of each run; default cores / jobs.")
]
MinutesOption = Annotated[
    float | None,
    typer.Option("--minutes", help="Stop then, write what there is; the same command goes on."),
]
PluginOption = Annotated[
    list[Path] | None,
    typer.Option("--plugin", help="Also load this plugin file. It is Python and will run."),
]


def pick_device(name: str) -> str:
    """Resolve "auto", and refuse a device that is not there."""
    import torch

    from hoigs.core.errors import HoigsError

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise HoigsError(f"--device {name}: this machine has no CUDA device; use --device cpu")
    return name


def overrides(values: Sequence[str] | None, rasterizer: str | None = None) -> list[str]:
    """`--set` values with `--rasterizer NAME` as one more."""
    chosen = list(values or [])
    if rasterizer is not None:
        key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
        chosen.append(f"rasterizer.use={key}")
    return chosen


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], notes: Sequence[str] = ()
) -> None:
    """A table on stdout: drawn for a terminal, plain columns for a pipe."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if Console().is_terminal else 160)
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*(str(cell) for cell in row))
    console.print(table)
    for note in notes:
        console.print(f"[dim]{note}[/dim]", highlight=False)


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
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
        console=console,
        transient=False,
        disable=not console.is_terminal,
    ) as progress:
        yield Bar(progress, progress.add_task(title, total=total, text=""))
