"""train: from a clip and a spec to a run folder with scores."""

from __future__ import annotations

import shlex
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from html import escape
from pathlib import Path

from hoigs.core.errors import Interrupted
from hoigs.core.options import verb
from hoigs.core.reporting import NotebookBar, Progress, in_notebook
from hoigs.core.system.random_state import callers_random_state
from hoigs.evaluation.evaluate_run import EvaluatedRun
from hoigs.evaluation.evaluate_run import evaluate as evaluate_run
from hoigs.evaluation.options import EvaluateOptions
from hoigs.evaluation.report.sections import clock
from hoigs.training.budget import plan_budget
from hoigs.training.options import TrainOptions
from hoigs.training.session import Session
from hoigs.training.trainer import StepReport
from hoigs.viewing.view import LiveView
from hoigs.viewing.viewer.server import LOCAL

OnStart = Callable[[Session], None]
OnStep = Callable[[StepReport], None]
Report = Callable[[str], None]


def silent(line: str) -> None:
    """A `report` that drops every line."""


@dataclass(frozen=True)
class TrainedRun:
    """A run that has just been trained.

    Attributes:
        path: the run folder. session: its spec, clip and trainer (with the model).
        evaluated: its scores; None with `evaluate=False`.
    """

    path: Path
    session: Session
    evaluated: EvaluatedRun | None

    def _repr_html_(self) -> str:
        scores = "" if self.evaluated is None else self.evaluated._repr_html_()
        return f"<p>run: {escape(str(self.path))}</p>{scores}"


@verb(TrainOptions, "spec")
@callers_random_state()
def train(
    clip: Path | str | None = None,
    *,
    options: TrainOptions,
    on_start: OnStart | None = None,
    on_step: OnStep | None = None,
    progress: Progress | None = None,
    report: Report = silent,
) -> TrainedRun:
    """Fit a model to a clip; then score it and write report.html.

    Args:
        clip: a clip folder, or "builtin:NAME"; with `resume` by default the run's.
        on_start: called with the Session once all input has been checked, before the first step.
        on_step: called with the StepReport of each logged step.
            A notebook shows bars in place of both, if neither is given.
        progress: called during the evaluation with the share done, in [0, 1], and the work.
        report: called with a line of text after each part of the work.

    Raises:
        HoigsError: the input is wrong; then nothing has been written.
        Interrupted: Ctrl-C or SIGTERM; the message has the command that continues.
    """
    began, plan = time.perf_counter(), None
    if options.budget is not None:
        spec, plan = plan_budget(clip, options)
        options = options.changed(
            spec=spec, overrides=(), rasterizer=None, chunk=None, budget=None
        )  # the spec has them
        report(plan.sentence())
    live = LiveView(options.port, options) if options.view else None
    session = Session.open(clip, options=options)
    path, trainer = session.run.path, session.trainer
    with live or nullcontext():
        if live is not None:
            trainer.viewed = True
            live.start(path)
            report(f"view: http://{LOCAL}:{live.port}, after the first step and until the end")
        if trainer.windows is not None:
            report(trainer.windows.sentence())
        graphs = trainer.gradients.sentence()
        if graphs is not None:
            report(graphs)
        if on_start is not None:
            on_start(session)
        session.train(on_step if on_step or not in_notebook() else _bar(session.spec.train.steps))
        for step, culprit in trainer.guard.skipped[:5]:
            report(f"skipped step {step}: {culprit} was not finite")
        used = {"cuda_graphs": trainer.gradients.used()}
        session.run.update(session.run.spec.read_text("utf-8"), used)
        if trainer.gradients.sentence() != graphs:
            report(f"since some step: {trainer.gradients.sentence()}")
        report(f"run: {path}")
        evaluated = _scored(path, options, progress, report) if options.evaluate else None
    if plan is not None:
        took = clock(time.perf_counter() - began)
        report(f"budget {clock(plan.limit_s)}: it took {took}")
    return TrainedRun(path, session, evaluated)


def _bar(steps: int) -> OnStep:
    """The steps as a notebook's bar."""
    show = NotebookBar()
    return lambda now: show(now.step / steps, f"step {now.step}, loss {now.loss:.4f}")


def _scored(
    path: Path, options: TrainOptions, progress: Progress | None, report: Report
) -> EvaluatedRun:
    """The scores of the run; an interrupt here leaves it trained, and says how to score it."""
    try:
        evaluated = evaluate_run(path, options=options.part(EvaluateOptions), progress=progress)
    except KeyboardInterrupt as stop:
        number = stop.code - 128 if isinstance(stop, Interrupted) else signal.SIGINT
        rest = f"stopped; {path} is trained, but not scored: hoigs eval {shlex.quote(str(path))}"
        raise Interrupted(rest, number) from stop
    report(f"report: {evaluated.report}")
    return evaluated
