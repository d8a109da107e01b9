"""`hoigs doctor`: what this machine has, and what each part of hoigs makes of it."""

from __future__ import annotations

from typing import Annotated

import typer

from hoigs.cli.common import print_table


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Check the installation: versions, devices, rasterizers, video codecs, LPIPS weights."""
    from hoigs.workflows.doctor import doctor as inspect

    rows = inspect()
    if as_json:
        import json

        typer.echo(json.dumps([row._asdict() | {"ok": row.ok} for row in rows], indent=1))
    else:
        print_table("hoigs doctor", ("what", "found", "note"), rows)
    if not all(row.ok for row in rows):
        raise typer.Exit(1)
