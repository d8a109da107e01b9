"""`hoigs plugins check`: hold components to what their interface promises."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from hoigs.cli.common import DeviceOption, PluginOption, SetOption
from hoigs.core.errors import HoigsError
from hoigs.runs.choices import pick_device


def check(
    name: Annotated[
        str,
        typer.Argument(help="A key, kind:name, or a plugin, whose components are all checked."),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with every result.")] = False,
    settings: SetOption = None,
    expect: Annotated[
        list[str] | None,
        typer.Option("--expect", help='A failure that is known: D09="why". Repeatable.'),
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(help="A clip in a reader's own layout, to check it with.")
    ] = None,
    device: DeviceOption = "cpu",
    plugin: PluginOption = None,
) -> None:
    """Run the conformance kit; exit code 1 when any check fails, or none could be run."""
    from hoigs.core.registry.registry import default_registry
    from hoigs.testing.runner import check_plugin

    try:
        reports = check_plugin(
            name,
            expected_failures=dict(_pair(text, "--expect") for text in expect or ()),
            settings={k: _value(v) for k, v in (_pair(t, "--set") for t in settings or ())},
            device=pick_device(device),
            folder=folder,
            registry=default_registry(plugin or ()),
        )
    except ValueError as error:  # an expected failure that is no check's id
        raise HoigsError(str(error)) from error
    if as_json:
        typer.echo(json.dumps({"reports": [report.as_dict() for report in reports]}, indent=1))
    else:
        typer.echo("\n".join(map(str, reports)))
    if not all(report.ok for report in reports):
        raise typer.Exit(1)


def _pair(text: str, option: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise HoigsError(f"{option} {text}: expected {option} NAME=VALUE")
    return key, value


def _value(text: str) -> Any:
    """A setting as a spec would read it."""
    import yaml

    return yaml.safe_load(text)
