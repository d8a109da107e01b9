"""`hoigs refine`: the body poses of a clip, corrected by drawing all its frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import DeviceOption, OverwriteOption, SetOption
from hoigs.cli.display import Display


def refine(
    clip: Annotated[Path, typer.Argument(help="Clip folder, as `hoigs prepare` makes it.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the refined clip; with --overwrite also CLIP.")
    ],
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, help="Default: 12.5 a frame, from 800 to 2000."),
    ] = None,
    width: Annotated[
        int, typer.Option("--width", min=16, help="Of the images that are compared, pixels.")
    ] = 256,
    settings: SetOption = None,
    device: DeviceOption = "auto",
    overwrite: OverwriteOption = False,
) -> None:
    """Correct the estimated body poses of a clip by a short training of the people on all frames.

    Frames that `hoigs train` keeps for tests are among them: the clip says so.
    """
    from hoigs.workflows.refine_poses import refine_poses

    with Display() as show:
        done = refine_poses(
            clip, out, steps=steps, width=width, overrides=settings or (),
            device=device, overwrite=overwrite,
            progress=show.fraction,
        )  # fmt: skip
        show.line(str(done))
        show.line(f"clip: {done.path}")
