"""`hoigs doctor`: what this machine has, and what each part of hoigs makes of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from hoigs.cli.common import print_table


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Check the installation: versions, devices, rasterizers, video codecs, LPIPS weights."""
    from hoigs.studies.doctor import doctor as inspect

    rows = inspect()
    if as_json:
        typer.echo(json.dumps([row._asdict() | {"ok": row.ok} for row in rows], indent=1))
    else:
        print_table("hoigs doctor", ("what", "found", "note"), rows)
    if not all(row.ok for row in rows):
        raise typer.Exit(1)


# `hoigs bug-report`: what helps to find a fault, without private paths or pictures.


def bug_report(
    run: Annotated[
        Path | None, typer.Argument(help="A run folder whose text files are added.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The zip to write.")] = Path(
        "hoigs-bug-report.zip"
    ),
) -> None:
    """Write a zip for a bug report: doctor's results, plugins and the text files of a run.

    It holds no picture, mask, weight or clip. Folders and names of user and machine are replaced.
    """
    from hoigs.studies.doctor import bug_report as write

    for name, size in write(run, out=out).items():
        typer.echo(f"{name}: {size} bytes")
    typer.echo(f"wrote {out}; look at its texts before you send it")
