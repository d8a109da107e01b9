"""`hoigs needs`: how much model a clip needs, and why; its answer is a spec."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import (
    DeviceOption,
    PluginOption,
    RasterizerOption,
    SetOption,
    overrides,
    pick_device,
    print_table,
)

if TYPE_CHECKING:
    from hoigs.studies.needs.search import Needs

CriterionOption = Annotated[
    str,
    typer.Option(
        "--criterion", help="one-se: the cheapest rung within one standard error of the best; bic."
    ),
]
LaddersOption = Annotated[
    Path | None, typer.Option("--ladders", help="A YAML file of ladders in place of hoigs's own.")
]


def needs(
    clip: Annotated[
        Path, typer.Argument(help="Clip folder, as `hoigs prepare` makes it, or builtin:NAME.")
    ],
    spec: Annotated[
        str, typer.Option("--spec", help="The spec that is to be cut down; a name or a file.")
    ] = "hoigs",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the answer; default runs/needs-CLIP.")
    ] = None,
    criterion: CriterionOption = "one-se",
    least: Annotated[
        float, typer.Option("--least", min=0, help="Gains below this, dB, count for nothing.")
    ] = 0.1,
    share: Annotated[
        float, typer.Option("--share", help="Of the training frames, to be held back (3 at least).")
    ] = 0.05,
    ladders: LaddersOption = None,
    settings: SetOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the answer in --out.")
    ] = False,
    allow_faults: Annotated[
        bool, typer.Option("--allow-faults", help="As for `hoigs train`.")
    ] = False,
    plugin: PluginOption = None,
) -> None:
    """Climb ladders of models, cheapest first, on training frames held back: which rung of each
    this clip needs. Writes spec.yaml, needs.md, needs.json, needs.png and needs.svg."""
    from hoigs.training.clip_source import clip_name

    folder = out or Path("runs") / f"needs-{clip_name(clip)}"
    find_needs(
        clip,
        spec,
        folder,
        given=overrides(settings, rasterizer),
        criterion=criterion,
        least=least,
        share=share,
        ladders=ladders,
        device=pick_device(device),
        overwrite=overwrite,
        allow_faults=allow_faults,
        plugins=plugin or (),
    )
    typer.echo(f"train it: hoigs train {clip} --spec {folder / 'spec.yaml'}")


def find_needs(
    clip: Path,
    spec: str,
    folder: Path,
    *,
    given: Sequence[str] = (),
    criterion: str = "one-se",
    least: float = 0.1,
    share: float = 0.05,
    ladders: Path | None = None,
    device: str = "cpu",
    overwrite: bool = False,
    allow_faults: bool = False,
    plugins: Sequence[Path] = (),
) -> Needs:
    """Search, write and print; shared with `hoigs train --auto`."""
    from hoigs.core.errors import HoigsError, did_you_mean
    from hoigs.core.registry import default_registry
    from hoigs.core.spec import Spec
    from hoigs.studies.needs.criterion import CRITERIA
    from hoigs.studies.needs.rungs import load_ladders
    from hoigs.studies.needs.search import Search, Settings
    from hoigs.studies.needs.write_needs import method, require_new, row, write_needs
    from hoigs.training.session import read_clip

    rule = next((c for c in CRITERIA if c == criterion), None)
    if rule is None:
        near = did_you_mean(criterion, CRITERIA)
        raise HoigsError(f"--criterion {criterion}: expected {' or '.join(CRITERIA)}{near}")
    if not 0 <= share < 0.5:
        raise HoigsError(f"--share {share}: expected a share of the training frames below 0.5")
    require_new(folder, overwrite)
    registry = default_registry(plugin_files=plugins)
    width = Spec.load(spec, overrides=given, registry=registry).train.width
    source = read_clip(clip, registry, width, allow_faults=allow_faults)
    typer.echo(f"what {source.name} needs of {spec}:")
    found = Search(
        source,
        spec,
        load_ladders(ladders),
        given,
        Settings(rule, least, share),
        registry,
        device,
        lambda line: typer.echo(f"  {line}"),
    ).run()
    columns = ("rung", "held-back dB", "over chosen dB", "parameters", "steps", "verdict")
    for answer in found.answers:
        if answer.steps:
            print_table(answer.title, columns, [row(answer, step) for step in answer.steps])
    for sentence in method(found):
        typer.echo(sentence)
    for path in write_needs(found, folder, given=given, registry=registry):
        typer.echo(f"wrote {path}")
    return found
