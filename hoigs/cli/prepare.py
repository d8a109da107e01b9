"""`hoigs prepare`: make a clip folder from a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import print_table
from hoigs.cli.display import Display


def prepare(
    source: Annotated[
        Path,
        typer.Argument(help="A video, or a folder with a video or frames and further inputs."),
    ],
    out: Annotated[Path, typer.Option("--out", help="Clip folder to make.")],
    width: Annotated[
        int | None, typer.Option("--width", help="Resize frames; default: the video's own.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            help="auto, static, moving (COLMAP's model beside the video, or structure from motion) "
            "or sfm (structure from motion in any case).",
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
    focal: Annotated[
        float | None, typer.Option("--focal", help="Focal length in pixels of the video, if known.")
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
    from hoigs.preparation.prepare import prepare as run
    from hoigs.preparation.prepare import prepare_until, work_folder
    from hoigs.preparation.settings import load_options

    flags = {
        "width": width, "camera": camera, "max_frames": max_frames, "every": every, "fps": fps,
        "focal": focal, "keep_black": keep_black, "overwrite": overwrite,
    }  # fmt: skip
    options = load_options(file, settings or (), flags)
    if stage is not None:
        with Display() as show:
            seconds = prepare_until(
                stage, source, out, options=options, progress=show.fraction,
                redo=redo or (), allow_commands=allow_commands,
            )  # fmt: skip
        rows = [(name, f"{value:.1f} s") for name, value in seconds.items()]
        print_table(f"stages kept in {work_folder(out)}", ("stage", "made in"), rows)
        return
    with Display() as show:
        report = run(
            source, out, options=options, progress=show.fraction,
            redo=redo or (), allow_commands=allow_commands,
        )  # fmt: skip
    print_table(f"prepared {out}", ("what", "value", "note"), report.rows())
    typer.echo(f"clip: {out}")
