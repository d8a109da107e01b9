"""`hoigs spec list|check|show`: built-in specs and spec files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import PluginOption, SetOption

if TYPE_CHECKING:
    from hoigs.core.spec.schema import Spec

app = typer.Typer(help="List, check and show specs.", no_args_is_help=True)

NameOrFile = Annotated[
    str,
    typer.Argument(help="A built-in spec's name, or a .yaml or .toml file; @PROFILE may follow."),
]


@app.command("list")
def list_specs() -> None:
    """Names and summaries of the built-in specs, and their profiles besides the native one."""
    from hoigs.core.spec.schema import builtin_specs, builtin_summary, spec_profiles

    for name in builtin_specs():
        profiles = "".join(f" @{profile}" for profile in spec_profiles(name)[1:])
        typer.echo(
            f"{name:<24} {builtin_summary(name)}{f' [{profiles.strip()}]' if profiles else ''}"
        )


@app.command("check")
def check(spec: NameOrFile, settings: SetOption = None, plugin: PluginOption = None) -> None:
    """Check a spec and all its profiles, and list its components."""
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.spec.fits import require_fitting
    from hoigs.core.spec.schema import spec_profiles

    profiles = [f"{spec}@{profile}" for profile in spec_profiles(spec)[1:]]
    for loaded in [_load(one, settings, plugin) for one in (spec, *profiles)]:
        require_fitting(loaded, default_registry(plugin or ()))
        typer.echo(f"{loaded.name}: ok")
        for place, key in loaded.components().items():
            typer.echo(f"  {place:<28} {key}")


@app.command("show")
def show(spec: NameOrFile, settings: SetOption = None, plugin: PluginOption = None) -> None:
    """Print a spec with all defaults; the output is a spec."""
    typer.echo(_load(spec, settings, plugin).dump(), nl=False)


def _load(spec: str, settings: Sequence[str] | None, plugin: Sequence[Path] | None) -> Spec:
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.spec.schema import Spec

    return Spec.load(spec, overrides=settings or (), registry=default_registry(plugin or ()))
