"""`hoigs plugins show`: all there is to know of one component, or of a plugin that failed."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hoigs.cli.common import PluginOption

if TYPE_CHECKING:
    from hoigs.core.registry.manager import Offer, Plugin
    from hoigs.core.registry.registry import Registry


def show(
    name: Annotated[
        str, typer.Argument(help="kind:name, kind:name@distribution, or a plugin's name.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    plugin: PluginOption = None,
) -> None:
    """Show a component: where it is from, how it stands, its settings with defaults and meaning."""
    from hoigs.core.registry.registry import default_registry

    pages = describe_all(name, default_registry(plugin or ()))
    if as_json:
        import json

        typer.echo(json.dumps(pages, indent=1))
        return
    typer.echo("\n\n".join(as_text(page) for page in pages))


def describe_all(name: str, registry: Registry) -> list[dict[str, Any]]:
    """A page for each component or plugin that `name` means.

    Raises:
        PluginError: it means none; with the nearest name.
    """
    from hoigs.core.errors import PluginError, did_you_mean
    from hoigs.core.registry.manager import normal_name

    manager = registry.manager
    wanted = normal_name(name)
    offers = [o for o in manager.offers if wanted in (normal_name(o.key), normal_name(o.exact))]
    if offers:
        return [_component(offer, registry) for offer in offers]
    plugins = [p for p in manager.plugins if wanted in (normal_name(p.dist), normal_name(p.name))]
    if plugins:
        return [_plugin(plugin, registry) for plugin in plugins]
    if ":" in name and "@" not in name:
        registry.component(name)  # raises: it knows which kinds and names there are
    known = [o.exact for o in manager.offers] + [o.key for o in manager.offers]
    known += [n for p in manager.plugins for n in (p.dist, p.name)]
    raise PluginError(
        f'"{name}" is neither a component nor a plugin{did_you_mean(name, known)}; '
        "`hoigs plugins` lists both"
    )


def _component(offer: Offer, registry: Registry) -> dict[str, Any]:
    """The page of a component; it is imported for that, and the time is taken."""
    registry.check(offer)
    began = time.perf_counter()
    registry.try_loading(offer)
    seconds = time.perf_counter() - began
    page = {
        "component": offer.exact,
        "summary": offer.component.summary,
        "status": str(offer.status),
        "error": offer.error,
        "traceback": offer.traceback,
        "target": offer.component.target,
        "config": offer.component.config,
        "api": offer.component.api,
        "extra": offer.component.extra,
        **_origin(offer.plugin),
        "component import": f"{seconds:.2f} s",
        "settings": None,
    }
    if offer.status == "ok":
        from hoigs.core.registry.settings import describe_settings

        page["settings"] = [
            asdict(s) for s in describe_settings(registry.config_class(offer.exact))
        ]
    return page


def _plugin(plugin: Plugin, registry: Registry) -> dict[str, Any]:
    """The page of a plugin: what there is when it offers nothing."""
    return {
        "plugin": plugin.name,
        "status": str(plugin.status),
        "error": plugin.error,
        "traceback": plugin.traceback,
        **_origin(plugin),
        "offers": [o.exact for o in registry.manager.offers if o.plugin is plugin],
    }


def _origin(plugin: Plugin) -> dict[str, Any]:
    return {
        "distribution": f"{plugin.dist} {plugin.version}",
        "entry point": f"{plugin.name} = {plugin.module}",
        "plugin import": f"{plugin.seconds:.2f} s",
        "remarks": plugin.remarks,
    }


def as_text(page: dict[str, Any]) -> str:
    """A page for reading; what does not apply is left out."""

    lines = []
    for name, value in page.items():
        if name == "settings" or value in (None, "", []):
            continue
        if name == "traceback":
            lines += ["traceback:", *(f"    {line}" for line in value.splitlines())]
        elif isinstance(value, list):
            lines += [f"{name}:", *(f"    {one_line(item)}" for item in value)]
        else:
            lines.append(f"{name + ':':<18} {one_line(str(value))}")
    if page.get("settings") is not None:
        lines.append("settings:" if page["settings"] else "settings:          none")
        for row in page["settings"]:
            default = "required" if row["default"] is None else f"default {row['default']}"
            lines.append(f"    {row['name']}: {row['type']}; {default}")
            if row["meaning"]:
                lines.append(f"        {row['meaning']}")
    return "\n".join(lines)


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, which text of plugins may contain."""
    return "".join(c for c in " ".join(text.split()) if c.isprintable())
