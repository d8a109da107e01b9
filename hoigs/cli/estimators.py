"""`hoigs estimators`: the environments that estimators run in."""

from __future__ import annotations

from typing import Annotated

import typer

from hoigs.cli.common import print_table
from hoigs.cli.display import Display

app = typer.Typer(
    help="Environments that estimators run in: list, install, remove.", no_args_is_help=True
)
Name = Annotated[str, typer.Argument(help="Environment, as `hoigs estimators list` names it.")]


@app.command("list")
def list_environments() -> None:
    """List the environments, and whether they are installed."""
    from hoigs.core.registry.environments import known_environments

    rows = []
    for environment in known_environments().values():
        state = environment.description().get("versions") or "not installed"
        where = str(environment.folder) if environment.installed else ""
        rows.append((environment.name, state, environment.summary, where))
        rows += [("", f"lacks {name}", why, "") for name, why in environment.lacking().items()]
    print_table("environments of estimators", ("name", "state", "what", "folder"), rows)


@app.command("install")
def install(name: Name) -> None:
    """Make an environment: download its packages, check their hashes, try it."""
    from hoigs.core.registry.environments import environment_named

    environment = environment_named(name)
    with Display() as show:
        environment.install(show.fraction)
    typer.echo(f"{name}: {environment.description()['versions']}, in {environment.folder}")
    for file, why in environment.lacking().items():
        typer.echo(f"warning: {file}: {why}", err=True)


@app.command("remove")
def remove(name: Name) -> None:
    """Remove an environment and its downloads."""
    from hoigs.core.registry.environments import environment_named

    removed = environment_named(name).remove()
    typer.echo(f"{name} removed" if removed else f"{name} was not installed")
