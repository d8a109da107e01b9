"""`hoigs doctor`: what this machine has, and what each part of hoigs makes of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from hoigs.cli.common import print_table

if TYPE_CHECKING:
    pass

Row = tuple[str, str, str]


def doctor() -> None:
    """Check the installation: versions, devices, rasterizers, bodies, LPIPS weights."""
    from hoigs.workflows.doctor import doctor as inspect

    rows = inspect()
    print_table("hoigs doctor", ("what", "found", "note"), rows)
    if not all(row.ok for row in rows):
        raise typer.Exit(1)
