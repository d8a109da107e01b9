"""Options, tables and progress bars that commands share; imports no torch."""

from __future__ import annotations

import functools
import inspect
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hoigs.core.reporting import Progress
from hoigs.core.system.files import printable

if TYPE_CHECKING:
    from hoigs.evaluation.evaluate_run import EvaluatedRun
    from hoigs.training.session import Session
    from hoigs.training.train import TrainedRun
    from hoigs.training.trainer import StepReport
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Set one key of the spec: train.steps=500. Repeatable."),
]
DeviceOption = Annotated[
    str, typer.Option("--device", "-d", help="cpu, cuda, or auto: cuda if available.")
]
ClipOption = Annotated[
    Path | None, typer.Option("--clip", help="The clip, if it was moved: a folder or builtin:NAME.")
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


class Talk:
    """How much commands say, as `-q` and `-v` set it.

    Attributes:
        quiet: results and warnings alone. verbose: each step of the work as a line, with its time.
        tables: where tables go in place of the terminal, with `--json`.
    """

    quiet = verbose = False
    tables: list[dict[str, Any]] | None = None


def with_json(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that prints tables the flag --json: stdout is one list of them, and all else
    that it says goes to stderr."""

    @functools.wraps(command)
    def called(*, as_json: bool, **values: Any) -> None:
        if not as_json:
            return command(**values)
        Talk.tables = []
        try:
            with redirect_stdout(sys.stderr):
                command(**values)
        finally:
            tables, Talk.tables = Talk.tables, None
        typer.echo(json.dumps(tables, indent=1))

    flag = Annotated[bool, typer.Option("--json", help="Print the tables as JSON.")]
    own = inspect.signature(command, eval_str=True).parameters.values()
    kinds = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
    last = inspect.Parameter(
        "as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=flag
    )
    called.__signature__ = inspect.Signature([*kinds, last])  # type: ignore[attr-defined]
    called.__annotations__ = {p.name: p.annotation for p in (*kinds, last)}
    return called


def _plain(cell: Any) -> Any:
    """A cell for JSON: a number where it is one."""
    try:
        return cell if isinstance(cell, int | float) else float(str(cell))
    except ValueError:
        return str(cell)


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    notes: Sequence[str] = (),
    *,
    widest: int | None = None,
) -> None:
    """Print a table on stdout; without rows its title and notes alone.

    With --json it is kept for the end (`with_json`). No cell is cut: in a terminal that is too
    narrow lines break, between words where these fit; elsewhere lines are as long as they need to
    be, or as `widest` allows.
    """
    if Talk.tables is not None:
        lines = [dict(zip(columns, map(_plain, row), strict=True)) for row in rows]
        Talk.tables.append({"title": title, "rows": lines, "notes": list(notes)})
        return
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
        side: Any = "right" if numbers else "left"
        table.add_column(escape(cells[0][i]), justify=side, overflow="fold", width=width)
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


@contextmanager
def progress_bar(title: str, total: float) -> Iterator[Progress]:
    """A bar with elapsed time and ETA on stderr; quiet when stderr is not a terminal, or with -q.

    It is moved by a call with what is done and a text. In a notebook it is the notebook's own kind
    of output, which rich makes.
    """
    from rich import progress as bars
    from rich.console import Console

    console = Console(stderr=True)
    count = "{task.completed:.0f}/{task.total:.0f}" if total > 1 else "{task.percentage:.0f} %"
    with bars.Progress(
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TextColumn(count),
        bars.TimeElapsedColumn(),
        bars.TextColumn("ETA"),
        bars.TimeRemainingColumn(),
        bars.TextColumn("{task.fields[text]}"),
        console=console,
        transient=False,
        disable=Talk.quiet or not (console.is_terminal or console.is_jupyter),
    ) as progress:
        task = progress.add_task(title, total=total, text="")
        yield lambda done, text: progress.update(task, completed=done, text=text)


# Display of long commands: lines on stdout, and one progress bar at a time on stderr.


def say(text: str) -> None:
    """A line on stdout, but not with -q; a reader that has left (`hoigs train … | head`) does not
    end the work."""
    if Talk.quiet:
        return
    try:
        typer.echo(text)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


SILENCE = 20.0  # seconds between lines where no terminal shows a bar


class Display:
    """Callbacks of the public functions, as methods; leaving the context ends the bar."""

    def __init__(self) -> None:
        self._bars = ExitStack()
        self._bar: Progress | None = None
        self._steps = 0
        self._began, self._last = time.perf_counter(), ""
        self._said = 0.0  # seconds after which the last line went to stderr
        self._psnr: dict[str, float] = {}

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *error: object) -> None:
        self._end_bar()

    def line(self, text: str) -> None:
        """`report`: a line on stdout."""
        self._end_bar()
        say(printable(text))

    def started(self, session: Session) -> None:
        """`on_start`: print the training and the faults of the clip, and start a bar."""
        self._end_bar()
        self._steps, width = session.spec.train.steps, session.spec.train.width
        camera = session.clip.cameras[0]
        if width is not None and camera.width < width:
            say(f"train.width={width} is wider than the clip: its {camera.width} pixels are kept")
        say(
            f"training {session.spec.name} on {printable(session.clip.name)} ({session.reader}): "
            f"{self._steps} steps, {len(session.clip.split['train'])} of "
            f"{session.clip.num_frames} frames, "
            f"{camera.width}x{camera.height} pixels"
        )
        for change in session.changes:
            say(printable(f"changed on resuming: {change}"))
        for fault in session.faults:
            typer.echo(printable(f"warning: {fault}"), err=True)
        self._psnr = {}
        self._bar = self._bars.enter_context(progress_bar("training", self._steps))

    def step(self, report: StepReport) -> None:
        """`on_step`: update the bar, and print a line when test frames were scored."""
        assert self._bar is not None
        self._psnr.update(report.psnr)
        score = f" test {self._psnr['test']:.2f} dB" if "test" in self._psnr else ""
        gaussians = sum(report.counts.values())
        self._bar(report.step, f"loss {report.loss:.4f}{score} {gaussians} Gaussians")
        if report.psnr:
            rest = (self._steps - report.step) * report.time_s / report.step
            say(
                f"step {report.step:>6}  {report.time_s:7.1f} s  ETA {rest:6.0f} s  "
                f"loss {report.loss:.4f} {score}  {gaussians} Gaussians"
            )

    def fraction(self, done: float, text: str) -> None:
        """`progress`: a bar over a job that reports fractions; with -v also a line a step, and
        where no terminal shows the bar, now and then a line on stderr."""
        seconds = time.perf_counter() - self._began
        line = f"{seconds:7.1f} s  {100 * done:3.0f} %  {printable(text)}"
        shown = Talk.quiet or Talk.verbose or sys.stderr.isatty()
        if Talk.verbose and text != self._last:
            self._last = text
            say(line)
        elif not shown and seconds - self._said >= SILENCE:
            self._said = seconds
            typer.echo(line, err=True)
        if self._bar is None:
            self._bar = self._bars.enter_context(progress_bar("working", 1.0))
        self._bar(done, text)

    def _end_bar(self) -> None:
        self._bars.close()
        self._bar = None


def print_scores(evaluated: EvaluatedRun) -> None:
    """The tables of an evaluated run; a note that several have is printed once."""
    printed: set[str] = set()
    for table in evaluated.evaluation.tables():
        notes = [note for note in table.notes if note not in printed]
        print_table(table.title, table.columns, table.rows, notes)
        printed.update(notes)


def print_summary(runs: dict[str, TrainedRun]) -> None:
    """PSNR of the runs, region by region, on the same frames; the reports have all scores."""
    regions = ("full", "human_object", "human", "object", "interaction", "background")
    rows, given = [], ""
    for name, run in runs.items():
        assert run.evaluated is not None
        for view in run.evaluated.evaluation.views:
            found = [run.evaluated.evaluation.score(r, "psnr", view.name) for r in regions]
            scores = (f"{s:.2f}" if isinstance(s, float) else str(s) for s in found)
            rows.append((name, view.name, *scores))
        given = given or run.evaluated.evaluation.views[0].protocol.given()
    title = "; ".join(("PSNR, dB", *filter(None, [given])))
    print_table(title, ("spec", "on", *regions), rows)
