"""`hoigs prepare`: a video with what is known of it in, a clip folder out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import print_table, progress_bar


def prepare(
    source: Annotated[
        Path, typer.Argument(help="Folder with video.mp4, masks, landmarks …, or a clip to check.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Clip folder to make.")],
    width: Annotated[
        int | None, typer.Option("--width", help="Resize frames; default: the video's own.")
    ] = None,
    max_frames: Annotated[
        int | None, typer.Option("--max-frames", help="Use only the first frames.")
    ] = None,
    every: Annotated[int, typer.Option("--every", help="Use every n-th frame.")] = 1,
    focal: Annotated[
        float | None, typer.Option("--focal", help="Focal length in pixels of the video, if known.")
    ] = None,
    keep_black: Annotated[
        bool,
        typer.Option("--keep-black", help="Learn flat black patches; default: they are ignored."),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the clip.")] = False,
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
    from hoigs.preparation.prepare import PrepareOptions, prepare_until, work_folder
    from hoigs.preparation.prepare import prepare as run

    options = PrepareOptions(
        width=width, max_frames=max_frames, every=every, focal=focal, keep_black=keep_black,
        overwrite=overwrite,
    )  # fmt: skip
    body = default_registry().get("body:anny")()
    with progress_bar("preparing", 1.0) as bar:
        if stage is not None:
            seconds = prepare_until(
                stage, source, out, options=options, body=body, progress=bar.update, redo=redo or ()
            )
        else:
            report = run(
                source, out, options=options, body=body, progress=bar.update, redo=redo or ()
            )
    if stage is not None:
        rows = [(name, f"{value:.1f} s") for name, value in seconds.items()]
        print_table(f"stages kept in {work_folder(out)}", ("stage", "made in"), rows)
        return
    print_table(f"prepared {out}", ("what", "value", "note"), report.rows())
    typer.echo(f"clip: {out}")
