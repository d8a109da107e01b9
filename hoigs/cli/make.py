"""The verbs that make a clip or a first run: `hoigs demo`, `prepare`, `refine` and `annotate`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import Display, print_scores, print_table
from hoigs.cli.options import flags
from hoigs.core.system.files import printable
from hoigs.training.options import DemoOptions, RefineOptions

if TYPE_CHECKING:
    from hoigs.preparation.estimates.plan import Consent, EstimatorPlan
    from hoigs.training.train import TrainedRun


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
    for run in runs.values():
        assert run.evaluated is not None
        print_scores(run.evaluated)
    _compare(runs)
    typer.echo(
        f"demo took {time.perf_counter() - began:.0f} s; open {Path(options.out) / 'report.html'}"
    )


def _compare(runs: dict[str, TrainedRun]) -> None:
    """PSNR of the runs, region by region, on the same test frames."""
    regions = ("full", "human_object", "human", "object", "interaction", "background")
    rows, given = [], []
    for name, run in runs.items():
        assert run.evaluated is not None
        scores = [run.evaluated.evaluation.score(region, "psnr") for region in regions]
        rows.append((name, *(f"{s:.2f}" if isinstance(s, float) else str(s) for s in scores)))
        given.append(run.evaluated.evaluation.views[0].protocol.given())
    title = "; ".join(("PSNR on test frames, dB", *filter(None, given[:1])))
    print_table(title, ("spec", *regions), rows)


# `hoigs prepare`: make a clip folder from a video.


def prepare(
    source: Annotated[
        Path,
        typer.Argument(
            help="A video, or a folder with a video or frames and further inputs; or a URL of one."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Clip folder to make.")],
    object_at: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            help="The object: a point 640,402 or 640,402@FRAME, one beside it -700,380, a box "
            'x0,y0,x1,y1, words "football" (with --estimators hub), or none. Repeatable.',
        ),
    ] = None,
    person: Annotated[
        list[str] | None,
        typer.Option(
            "--person",
            help="Which person to fit where several are seen: a point on them, 320,210 or "
            "320,210@FRAME, or a box, as with --object; several people with names, "
            "anna=320,210; all, or none. Repeatable.",
        ),
    ] = None,
    estimators: Annotated[
        str | None,
        typer.Option(
            "--estimators",
            help="What finds landmarks and masks that no file beside the video gives: offline "
            "(MediaPipe and hoigs's tracker; default), hub (networks), or files (nothing does).",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Install and download what is needed, unasked.")
    ] = False,
    width: Annotated[
        int | None, typer.Option("--width", help="Resize frames; default: the video's own.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            help="auto, static, turning (on its spot), moving (COLMAP's model beside the video, or "
            "structure from motion) or sfm (structure from motion in any case).",
        ),
    ] = None,
    max_frames: Annotated[
        int | None, typer.Option("--max-frames", help="Use only the first frames.")
    ] = None,
    every: Annotated[
        int | None, typer.Option("--every", help="Use the sharpest of each n frames.")
    ] = None,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Use this many frames a second, the sharpest.")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--start", help="Start here: 2.5 (seconds), 1:02.5, or 75f (frame 75 of the video)."
        ),
    ] = None,
    end: Annotated[str | None, typer.Option("--end", help="End before this, likewise.")] = None,
    focal: Annotated[
        float | None, typer.Option("--focal", help="Focal length in pixels of the video, if known.")
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(
            "--intrinsics",
            help="The lens, in pixels of the video: fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2.",
        ),
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            "--calibration",
            help="The lens, in a file of COLMAP, OpenCV, Qualisys or Pose2Sim; FILE#NAME of "
            "several.",
        ),
    ] = None,
    person_height: Annotated[
        float | None,
        typer.Option(
            "--person-height",
            help="Of the person standing, metres: the unit of the world comes from it.",
        ),
    ] = None,
    chunk: Annotated[
        int | None,
        typer.Option(
            "--chunk", help="For a long video: fit the body in windows of so many frames."
        ),
    ] = None,
    overlap: Annotated[
        int | None,
        typer.Option(
            "--overlap",
            help="Frames that two windows share; default: a quarter of --chunk, 50 at most.",
        ),
    ] = None,
    keep_black: Annotated[
        bool | None,
        typer.Option(
            "--keep-black", help="Train on uniform black areas; default: they are ignored."
        ),
    ] = None,
    overwrite: Annotated[bool | None, typer.Option("--overwrite", help="Replace the clip.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Any option: estimators.masks.use=estimator:masks-files, "
            "estimators.masks.path=sam2. Repeatable.",
        ),
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--options", help="YAML or TOML file of options.")
    ] = None,
    allow_commands: Annotated[
        bool,
        typer.Option(
            "--allow-commands",
            help="Let options run the programs that they name (estimator:command, "
            "estimator:mediapipe).",
        ),
    ] = False,
    redo: Annotated[
        list[str] | None,
        typer.Option(
            "--redo", help="Run this stage again, and those that depend on it. Repeatable."
        ),
    ] = None,
    stage: Annotated[
        str | None, typer.Option("--stage", help="Stop after this stage; no clip is written.")
    ] = None,
) -> None:
    """Make a clip folder from a video with the given estimators, and a report."""
    from hoigs.preparation.options import load_options
    from hoigs.preparation.prepare import prepare as run
    from hoigs.preparation.prepare import prepare_until, work_folder

    flags = {
        "width": width, "camera": camera, "max_frames": max_frames, "every": every, "fps": fps,
        "start": start, "end": end, "focal": focal, "intrinsics": intrinsics,
        "calibration": calibration, "person_height": person_height, "keep_black": keep_black,
        "overwrite": overwrite, "preset": estimators, "chunk": chunk, "overlap": overlap,
    }  # fmt: skip
    options = load_options(file, settings or (), flags)
    if stage is not None:
        with Display() as show:
            seconds = prepare_until(
                stage, source, out, options=options, progress=show.fraction,
                redo=redo or (), allow_commands=allow_commands, object=object_at or (),
                person=person or (), yes=yes, consent=_consent(), announce=_announce,
            )  # fmt: skip
        rows = [(name, f"{value:.1f} s") for name, value in seconds.items()]
        print_table(f"stages kept in {work_folder(out)}", ("stage", "made in"), rows)
        return
    with Display() as show:
        report = run(
            source, out, options=options, progress=show.fraction,
            redo=redo or (), allow_commands=allow_commands, object=object_at or (),
            person=person or (), yes=yes, consent=_consent(), announce=_announce,
        )  # fmt: skip
    print_table(f"prepared {out}", ("what", "value", "note"), report.rows())
    for warning in report.warnings:
        typer.echo(printable(f"- {warning}"))
    typer.echo(f"clip: {out}")
    typer.echo(f"report: {out / 'report.html'}")
    if (picture := out / "object.jpg").is_file():
        typer.echo(f"the object as it was found: {picture}")


def _announce(plan: EstimatorPlan) -> None:
    frames = "" if plan.frames is None else f" for {plan.frames} frames"
    if frames and not plan.counted:
        frames = f" for at most {plan.frames} frames, by the video's header"
    title = f"plan{frames}, with the time that each step takes on 2 cores"
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
        Path, typer.Option("--out", help="Folder of the refined clip; with --overwrite also CLIP.")
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
        Path | None, typer.Option("--out", help="Clip to prepare; default: clips/VIDEO'S NAME.")
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
    from hoigs.viewing.annotate.server import annotate as serve

    serve(
        video,
        out,
        port=port,
        overrides=settings or (),
        options=file,
        open_browser=browser,
        report=typer.echo,
    )
