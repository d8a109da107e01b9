"""`hoigs prepare`: a video with what is known of it in, a clip folder out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import print_table, progress_bar


def prepare(
    source: Annotated[
        Path,
        typer.Argument(
            help="Folder with a video, or with frames, and what is known of it; or the video."
        ),
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
        float | None, typer.Option("--fps", help="Use so many frames a second, the sharpest.")
    ] = None,
    focal: Annotated[
        float | None, typer.Option("--focal", help="Focal length in pixels of the video, if known.")
    ] = None,
    keep_black: Annotated[
        bool | None,
        typer.Option("--keep-black", help="Learn flat black patches; default: they are ignored."),
    ] = None,
    overwrite: Annotated[bool | None, typer.Option("--overwrite", help="Replace the clip.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Any option: priors.masks.use=prior:masks-files, priors.masks.path=sam2. "
            "Repeatable.",
        ),
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--options", help="YAML or TOML file of options.")
    ] = None,
    allow_commands: Annotated[
        bool,
        typer.Option(
            "--allow-commands",
            help="Let options run the programs that they name (prior:command, prior:mediapipe).",
        ),
    ] = False,
    redo: Annotated[
        list[str] | None,
        typer.Option("--redo", help="Run this stage anew, and what builds on it. Repeatable."),
    ] = None,
    stage: Annotated[
        str | None, typer.Option("--stage", help="Stop after this stage; no clip is written.")
    ] = None,
) -> None:
    """Turn a video and its priors into a clip folder, with a written report."""
    from hoigs.core.registry import default_registry
    from hoigs.preparation.prepare import prepare as run
    from hoigs.preparation.prepare import prepare_until, work_folder
    from hoigs.preparation.settings import load_options

    flags = {
        "width": width, "camera": camera, "max_frames": max_frames, "every": every, "fps": fps,
        "focal": focal, "keep_black": keep_black, "overwrite": overwrite,
    }  # fmt: skip
    options = load_options(file, settings or (), flags)
    body = default_registry().get("body:anny")()
    with progress_bar("preparing", 1.0) as bar:
        if stage is not None:
            seconds = prepare_until(
                stage, source, out, options=options, body=body, progress=bar.update,
                redo=redo or (), allow_commands=allow_commands,
            )  # fmt: skip
        else:
            report = run(
                source, out, options=options, body=body, progress=bar.update,
                redo=redo or (), allow_commands=allow_commands,
            )  # fmt: skip
    if stage is not None:
        rows = [(name, f"{value:.1f} s") for name, value in seconds.items()]
        print_table(f"stages kept in {work_folder(out)}", ("stage", "made in"), rows)
        return
    print_table(f"prepared {out}", ("what", "value", "note"), report.rows())
    typer.echo(f"clip: {out}")
