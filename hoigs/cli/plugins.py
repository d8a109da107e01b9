"""`hoigs plugins`: every component, how it stands, and who it came from. Imports no component."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from hoigs.cli.common import PluginOption
from hoigs.cli.plugins_check import check
from hoigs.cli.plugins_new import new
from hoigs.cli.plugins_show import one_line, show
from hoigs.core.names import printable

app = typer.Typer(invoke_without_command=True)
app.command("check")(check)
app.command("new")(new)
app.command("show")(show)

# Fixed, so that one plugin's line never moves another's.
LINE = "{key:<34} {status:<12} {origin:<28} {text}"


@app.callback()
def plugins(
    context: typer.Context,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON, with versions, targets and full errors.")
    ] = False,
    load: Annotated[
        bool,
        typer.Option("--load", help="Also import every component (slow): finds what fails then."),
    ] = False,
    plugin: PluginOption = None,
) -> None:
    """List all components with their status: ok, broken, conflict, blocked, incompatible,
    needs-extra; or one of the commands below."""
    if context.invoked_subcommand is not None:
        return
    rows, notes = list_plugins(load=load, files=plugin or ())
    if as_json:
        import json

        typer.echo(json.dumps({"plugins": rows, "notes": notes}, indent=1))
        return
    typer.echo(LINE.format(key="component", status="status", origin="from", text="summary"))
    for row in rows:
        origin = f"{row['dist']} {row['version']}"
        text = one_line(row["error"] or row["summary"])
        typer.echo(LINE.format(**{**row, "origin": origin, "text": text}).rstrip())
    for note in notes:
        typer.echo(printable(f"note: {note}"), err=True)


def list_plugins(*, load: bool = False, files: Any = ()) -> tuple[list[dict[str, Any]], list[str]]:
    """A row for each component, and for each plugin that failed, offers nothing or misbehaves.

    Args:
        load: import every component's class and config.
        files: plugin files to load as well.

    Returns:
        Rows with key, status, dist, version, target, summary, error, seconds (of the plugin's
        import); and notes on the settings.
    """
    from hoigs.core.registry.component import KINDS
    from hoigs.core.registry.manager import Status
    from hoigs.core.registry.registry import default_registry

    registry = default_registry(files)
    rows = []
    for offer in registry.manager.offers:
        registry.check(offer)
        if load:
            registry.try_loading(offer)
        rows.append(_row(offer.key, offer.plugin, offer.status, offer.error, offer.component))
    order = {kind: i for i, kind in enumerate(KINDS)}
    rows.sort(key=lambda r: (order.get(r["key"].partition(":")[0], 99), r["key"], r["dist"]))
    offering = {id(offer.plugin) for offer in registry.manager.offers}
    for plugin in sorted(registry.manager.plugins, key=lambda p: (p.dist, p.name)):
        remarks = list(plugin.remarks)
        if plugin.status is Status.OK and id(plugin) not in offering:
            remarks.insert(0, "offers nothing")
        if plugin.status is not Status.OK or remarks:
            text = "; ".join(filter(None, [plugin.error, *remarks]))
            rows.append(_row(f"(plugin {plugin.name})", plugin, plugin.status, text, None))
    return rows, registry.manager.notes


def _row(key: str, plugin: Any, status: str, error: str, component: Any) -> dict[str, Any]:
    return {
        "key": key,
        "status": str(status),
        "dist": plugin.dist,
        "version": plugin.version,
        "target": component.target if component is not None else plugin.module,
        "summary": component.summary if component is not None else "",
        "error": error,
        "seconds": round(plugin.seconds, 3),
    }
