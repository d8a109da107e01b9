"""`hoigs publish`: write a folder to object storage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def publish(
    folder: Annotated[Path, typer.Argument(help="A run, a clip or any other folder.")],
    url: Annotated[str, typer.Argument(help="Where to write it: s3://bucket/results/a.")],
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", help="A file or folder directly in it, in place of all. Repeatable."
        ),
    ] = None,
) -> None:
    """Upload a folder; complete.json, with the checksums of its files, is written last."""
    from hoigs.core.storage.publish import publish as write

    count = write(folder, url, only=only or ())
    typer.echo(f"{count} files and complete.json: {url}")
