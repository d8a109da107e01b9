"""The verbs that make a clip or a first run: `hoigs demo`, `prepare`, `refine` and `annotate`."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import Display, print_summary, print_table, say, with_json
from hoigs.cli.options import flags
from hoigs.core.errors import Interrupted
from hoigs.core.system.files import printable
from hoigs.preparation.options import PrepareOptions
from hoigs.training.options import DemoOptions, RefineOptions

if TYPE_CHECKING:
    from hoigs.preparation.estimates.plan import Consent, EstimatorPlan


@with_json
@flags(DemoOptions)
def demo(*, options: DemoOptions) -> None:
    """Generate a clip with known truth, reconstruct it, and write report.html."""
    from hoigs.training.demo import demo as run_demo

    began = time.perf_counter()
    with Display() as show:
        runs = run_demo(
            options=options, on_start=show.started, on_step=show.step, progress=show.fraction,
            report=show.line,
        )  # fmt: skip
    print_summary(runs)
    page = Path(options.out) / "report.html"
    typer.echo(f"demo took {time.perf_counter() - began:.0f} s; open {page}")


# `hoigs prepare`: make a clip folder from a video.


@with_json
@flags(PrepareOptions)
def prepare(
    source: Annotated[
        Path,
        typer.Argument(
            help="A video, or a folder with a video or frames and further inputs; or a URL of one."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Clip folder to make; default: clips/VIDEO'S NAME."),
    ] = None,
    stage: Annotated[
        str | None, typer.Option("--stage", help="Stop after this stage; no clip is written.")
    ] = None,
    *,
    options: PrepareOptions,
) -> None:
    """Turn a video into a clip: a folder with cameras, masks, body, objects, and a report."""
    from hoigs.preparation.prepare import prepare as run
    from hoigs.preparation.prepare import prepare_until, work_folder
    from hoigs.preparation.video.source import clip_named_after

    out = clip_named_after(source) if out is None else out
    if stage is not None:
        with Display() as show:
            seconds = prepare_until(
                stage, source, out, options=options, consent=_consent(), announce=_announce,
                progress=show.fraction,
            )  # fmt: skip
        rows = [(name, f"{value:.1f} s") for name, value in seconds.items()]
        print_table(f"stages kept in {work_folder(out)}", ("stage", "made in"), rows)
        return
    try:
        with Display() as show:
            report = run(
                source, out, options=options, consent=_consent(), announce=_announce,
                progress=show.fraction,
            )  # fmt: skip
    except Interrupted as stop:
        if not work_folder(out).is_dir():
            raise
        rest = f"{stop}; the same command continues: {work_folder(out)} keeps what is done"
        raise Interrupted(rest, stop.code - 128) from stop
    print_table(f"prepared {out}", ("what", "value", "note"), report.rows(), widest=120)
    for warning in report.warnings:
        typer.echo(printable(f"- {warning}"))
    typer.echo(f"clip: {out}")
    typer.echo(f"report: {out / 'report.html'}")
    if (picture := out / "object.jpg").is_file():
        typer.echo(f"the object as it was found: {picture}")
    say(f"train it: hoigs train {shlex.quote(str(out))}")


def _announce(plan: EstimatorPlan) -> None:
    frames = "" if plan.frames is None else f" for {plan.frames} frames"
    if frames and not plan.counted:
        frames = f" for at most {plan.frames} frames, by the video's header"
    title = f"plan{frames}, with times of 2 cores, longer where the camera moves"
    if plan.choices:
        print_table(title, ("what", "from", "why", "about"), plan.rows(), widest=80)
    for note in plan.notes:
        typer.echo(printable(note))


def _consent() -> Consent | None:
    """Asks on a terminal; elsewhere nobody can answer."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return None
    return lambda question: typer.confirm(question, default=True)


# `hoigs refine`: the body poses of a clip, corrected by drawing all its frames.


@flags(RefineOptions)
def refine(
    clip: Annotated[Path, typer.Argument(help="Clip folder, as `hoigs prepare` makes it.")],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder of the refined clip; with --overwrite also CLIP."),
    ],
    *,
    options: RefineOptions,
) -> None:
    """Correct the estimated body poses of a clip by a short training of the people on all frames.

    Frames that `hoigs train` keeps for tests are among them: the clip says so.
    """
    from hoigs.training.refine_poses import refine_poses

    with Display() as show:
        done = refine_poses(clip, out, options=options, progress=show.fraction)
        show.line(str(done))
        show.line(f"clip: {done.path}")


# `hoigs annotate`: click on people and objects of a video in a local page.


def annotate(
    video: Annotated[Path, typer.Argument(help="A video, or a folder with one or with frames.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Clip to prepare; default: clips/VIDEO'S NAME."),
    ] = None,
    port: Annotated[int, typer.Option("--port", help="0 finds a free one.")] = 8091,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
    ] = True,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any option of prepare: every=2, camera=static. Repeatable."),
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--options", help="YAML or TOML file of prepare's options.")
    ] = None,
) -> None:
    """Click on the people and objects of a video, see their masks, and prepare it."""
    say(f"starting the page of {video} …")
    from hoigs.viewing.annotate.server import annotate as serve

    options = PrepareOptions.of(file, {"overrides": settings or ()}, "annotate")
    serve(video, out, port=port, options=options, open_browser=browser, report=typer.echo)
