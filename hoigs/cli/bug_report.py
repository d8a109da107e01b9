"""`hoigs bug-report`: what helps to find a fault, without private paths or pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def bug_report(
    run: Annotated[
        Path | None, typer.Argument(help="A run folder whose text files are added.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="The zip to write.")] = Path(
        "hoigs-bug-report.zip"
    ),
) -> None:
    """Write a zip for a bug report: doctor's results, plugins and the text files of a run.

    It holds no picture, mask, weight or clip. Folders and names of user and machine are replaced.
    """
    from hoigs.workflows.bug_report import bug_report as write

    for name, size in write(run, out=out).items():
        typer.echo(f"{name}: {size} bytes")
    typer.echo(f"wrote {out}; look at its texts before you send it")
