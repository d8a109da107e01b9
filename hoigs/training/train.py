"""train: from a clip and a spec to a run folder with scores."""

from __future__ import annotations

import shlex
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.errors import HoigsError, Interrupted
from hoigs.core.reporting import Progress
from hoigs.core.spec.schema import Spec
from hoigs.core.system.random_state import callers_random_state
from hoigs.evaluation.evaluate_run import EvaluatedRun
from hoigs.evaluation.evaluate_run import evaluate as evaluate_run
from hoigs.evaluation.report.sections import clock
from hoigs.training.budget import plan_budget
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


@callers_random_state()
def train(
    clip: Path | str | None = None,
    spec: str | Path | Spec | None = None,
    *,
    out: Path | str | None = None,
    overrides: Sequence[str] = (),
    rasterizer: str | None = None,
    device: str = "auto",
    resume: bool = False,
    overwrite: bool = False,
    allow_faults: bool = False,
    reader: str | None = None,
    reader_settings: Sequence[str] = (),
    evaluate: bool = True,
    budget: str | float | None = None,
    chunk: int | None = None,
    plugins: Sequence[Path | str] = (),
    view: bool = False,
    port: int = 8090,
    on_start: OnStart | None = None,
    on_step: OnStep | None = None,
    progress: Progress | None = None,
    report: Report = silent,
) -> TrainedRun:
    """Fit a model to a clip; then score it and write report.html.

    Args:
        clip: a clip folder, or "builtin:NAME"; with `resume` by default the run's.
        spec: the name of a built-in spec ("hoigs", "hoigs@PROFILE"), a file, or a Spec; by default
            "hoigs", with `resume` the run's.
        out: the run folder; by default runs/CLIP-SPEC.
        overrides: settings laid over the spec's, "train.steps=500"; not with a Spec.
        rasterizer: "warp", "torch", "oracle" or a plugin's. device: "cpu", "cuda" or "auto".
        resume: continue the run in `out`, with its spec and clip unless others are given.
        overwrite: replace the run in `out`.
        allow_faults: train without masks, images and depth that are absent or broken.
        reader: reads the clip; by default the one that recognises its layout. reader_settings:
            of the reader, "masks=false".
        evaluate: score the run and write its report.
        budget: a time, "90s", "20m", "2h": image width and steps are chosen so that training and
            scores take about that long here. Not with `resume`.
        chunk: frames of a window, for a long clip (`train.chunk`): of what grows with the clip, one
            window's part is in memory at a time.
        plugins: Python files to load (and run) first.
        view: show the training in the browser while it lasts, by a process of its own that reads
            checkpoints, of which one is then written about every 10 seconds. port: of its address
            on this machine; 0 finds a free one.
        on_start: called with the Session once all input has been checked, before the first step.
        on_step: called with the StepReport of each logged step.
        progress: called during the evaluation with the share done, in [0, 1], and the work.
        report: called with a line of text after each part of the work.

    Raises:
        HoigsError: the input is wrong; then nothing has been written.
        Interrupted: Ctrl-C or SIGTERM; the message has the command that continues.
    """
    began, plan = time.perf_counter(), None
    if chunk is not None:
        overrides = [*overrides, f"train.chunk={chunk}"]
    if budget is not None:
        if resume:
            raise HoigsError("--budget plans a new run; a resumed one keeps its width and steps")
        spec, plan = plan_budget(
            clip, spec, budget, overrides=overrides, rasterizer=rasterizer, device=device,
            allow_faults=allow_faults, reader=reader, reader_settings=reader_settings,
            plugins=plugins,
        )  # fmt: skip
        overrides, rasterizer = (), None  # the spec has them
        report(plan.sentence())
    live = LiveView(port, device=device, rasterizer=rasterizer, plugins=plugins) if view else None
    session = Session.open(
        clip, spec, out=out, overrides=overrides, rasterizer=rasterizer, device=device,
        resume=resume, overwrite=overwrite, plugins=plugins, allow_faults=allow_faults,
        reader=reader, reader_settings=reader_settings,
    )  # fmt: skip
    with live or nullcontext():
        if live is not None:
            session.trainer.viewed = True
            live.start(session.run.path)
            report(f"view: http://{LOCAL}:{live.port}, after the first step and until the end")
        trained = _trained(session, device, evaluate, plugins, on_start, on_step, progress, report)
    if plan is not None:
        took = clock(time.perf_counter() - began)
        report(f"budget {clock(plan.limit_s)}: it took {took}")
    return trained


def _trained(
    session: Session,
    device: str,
    evaluate: bool,
    plugins: Sequence[Path | str],
    on_start: OnStart | None,
    on_step: OnStep | None,
    progress: Progress | None,
    report: Report,
) -> TrainedRun:
    """The rest of `train`: the steps and the scores."""
    if session.trainer.windows is not None:
        report(session.trainer.windows.sentence())
    if on_start is not None:
        on_start(session)
    session.train(on_step)
    for step, culprit in session.trainer.guard.skipped[:5]:
        report(f"skipped step {step}: {culprit} was not finite")
    without = session.trainer.objective.graphed_scene.why_slower()
    if without is not None:
        report(f"trained without CUDA graphs, slower than it could be: {without}")
    path = session.run.path
    report(f"run: {path}")
    if not evaluate:
        return TrainedRun(path, session, None)
    try:
        evaluated = evaluate_run(path, device=device, plugins=plugins, progress=progress)
    except KeyboardInterrupt as stop:
        number = stop.code - 128 if isinstance(stop, Interrupted) else signal.SIGINT
        rest = f"stopped; {path} is trained, but not scored: hoigs eval {shlex.quote(str(path))}"
        raise Interrupted(rest, number) from stop
    report(f"report: {evaluated.report}")
    return TrainedRun(path, session, evaluated)
