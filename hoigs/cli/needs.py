"""`hoigs needs`: find how much of a spec a clip needs; the answer is a spec."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import (
    AllowFaultsOption,
    DeviceOption,
    OverwriteOption,
    PluginOption,
    RasterizerOption,
    SetOption,
    print_table,
)
from hoigs.cli.display import Display

if TYPE_CHECKING:
    from hoigs.studies.needs.result import Needs

CriterionOption = Annotated[
    str,
    typer.Option(
        "--criterion",
        help="one-se: the cheapest candidate within one standard error of the best; or bic.",
    ),
]
SearchSpacesOption = Annotated[
    Path | None,
    typer.Option("--search-spaces", help="A YAML file of search spaces in place of hoigs's own."),
]


def needs(
    clip: Annotated[
        str, typer.Argument(help="Clip folder, as `hoigs prepare` makes it, or builtin:NAME.")
    ],
    spec: Annotated[
        str, typer.Option("--spec", help="The spec to reduce: a name or a file.")
    ] = "hoigs",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the answer; default runs/needs-CLIP.")
    ] = None,
    criterion: CriterionOption = "one-se",
    least: Annotated[
        float, typer.Option("--least", min=0, help="Ignore gains below this, dB.")
    ] = 0.1,
    share: Annotated[
        float,
        typer.Option("--share", help="Share of the training frames to hold back (at least 3)."),
    ] = 0.05,
    search_spaces: SearchSpacesOption = None,
    settings: SetOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    overwrite: OverwriteOption = False,
    allow_faults: AllowFaultsOption = False,
    plugin: PluginOption = None,
) -> None:
    """Find the smallest model that a clip needs, part by part, on training frames held back.

    Writes spec.yaml, needs.md, needs.json, needs.png and needs.svg.
    """
    from hoigs.studies.needs.needs import needs as find
    from hoigs.studies.needs.needs import needs_folder

    with Display() as show:
        found = find(
            clip, spec, out=out, criterion=criterion, least=least, share=share,
            search_spaces=search_spaces, overrides=settings or (), rasterizer=rasterizer,
            device=device, overwrite=overwrite, allow_faults=allow_faults, plugins=plugin or (),
            report=show.line,
        )  # fmt: skip
    print_needs(found)
    answer = (out or needs_folder(clip)) / "spec.yaml"
    typer.echo(f"train it: hoigs train {clip} --spec {answer}")


def print_needs(found: Needs) -> None:
    """A table for each search space, then the method."""
    from hoigs.studies.needs.report.write import method, row

    columns = ("candidate", "held-back dB", "gain over chosen dB", "parameters", "steps", "verdict")
    for answer in found.answers:
        if answer.steps:
            print_table(answer.title, columns, [row(answer, step) for step in answer.steps])
    for sentence in method(found):
        typer.echo(sentence)
