"""Display of long commands: lines on stdout, and one progress bar at a time on stderr."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING

import typer

from hoigs.cli.common import Bar, print_table, progress_bar
from hoigs.core.names import printable

if TYPE_CHECKING:
    from hoigs.training.reports import StepReport
    from hoigs.training.session import Session
    from hoigs.workflows.evaluate import EvaluatedRun


def say(text: str) -> None:
    """A line on stdout; a reader that has left (`hoigs train … | head`) does not end the work."""
    try:
        typer.echo(text)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Display:
    """Callbacks of the public functions, as methods; leaving the context ends the bar."""

    def __init__(self) -> None:
        self._bars = ExitStack()
        self._bar: Bar | None = None
        self._steps = 0
        self._psnr: dict[str, float] = {}

    def __enter__(self) -> Display:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        self._bar.update(report.step, f"loss {report.loss:.4f}{score} {gaussians} Gaussians")
        if report.psnr:
            rest = (self._steps - report.step) * report.time_s / report.step
            say(
                f"step {report.step:>6}  {report.time_s:7.1f} s  ETA {rest:6.0f} s  "
                f"loss {report.loss:.4f} {score}  {gaussians} Gaussians"
            )

    def fraction(self, done: float, text: str) -> None:
        """`progress`: a bar over a job that reports fractions."""
        if self._bar is None:
            self._bar = self._bars.enter_context(progress_bar("working", 1.0))
        self._bar.update(done, text)

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
