"""The verbs about parts: `hoigs plugins`, `spec` and `estimators`."""

from __future__ import annotations

import importlib.util
import json
import keyword
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from enum import StrEnum
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Annotated, Any

import typer
import yaml

from hoigs.cli.common import DeviceOption, Display, PluginOption, SetOption, print_table, with_json
from hoigs.core.errors import HoigsError, PluginError, SpecError, did_you_mean
from hoigs.core.system.files import printable
from hoigs.runs.choices import pick_device

if TYPE_CHECKING:
    from hoigs.core.registry.manager import Offer, Plugin
    from hoigs.core.registry.registry import Registry
    from hoigs.core.spec.schema import Spec


# `hoigs plugins show`: all there is to know of one component, or of a plugin that failed.


def show_plugin(
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
        typer.echo(json.dumps(pages, indent=1))
        return
    typer.echo("\n\n".join(as_text(page) for page in pages))


def describe_all(name: str, registry: Registry) -> list[dict[str, Any]]:
    """A page for each component or plugin that `name` means.

    Raises:
        PluginError: it means none; with the nearest name.
    """
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

        found = describe_settings(registry.config_class(offer.exact))
        page["settings"] = [asdict(s) for s in found]
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
        lines += settings_lines(page["settings"], "    ")
    return "\n".join(lines)


def settings_lines(rows: Sequence[Mapping[str, Any]], indent: str = "") -> list[str]:
    """Each setting with its type and default, and below it what it means."""
    lines = []
    for row in rows:
        default = "required" if row["default"] is None else f"default {row['default']}"
        lines.append(f"{indent}{row['name']}: {row['type']}; {default}")
        if row["meaning"]:
            lines.append(f"{indent}    {one_line(row['meaning'])}")
    return lines


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, which text of plugins may contain."""
    return "".join(c for c in " ".join(text.split()) if c.isprintable())


# `hoigs plugins check`: hold components to what their interface promises.


def check_plugins(
    name: Annotated[
        str, typer.Argument(help="A key, kind:name, or a plugin, whose components are all checked.")
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
            settings={k: yaml.safe_load(v) for k, v in (_pair(t, "--set") for t in settings or ())},
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


# `hoigs plugins new`: a package with one component, to be filled with a method of one's own.

TEMPLATES = "templates"
SUFFIX = ".tmpl"
_NAME = re.compile(r"[a-z][a-z0-9]*(?:-[a-z0-9]+)*")


class NewKind(StrEnum):
    """Kinds that there is a template for."""

    deformation = "deformation"
    features = "features"
    interaction = "interaction"
    density = "density"
    reader = "reader"
    rasterizer = "rasterizer"
    exporter = "exporter"
    objective = "objective"
    decoder = "decoder"


SUMMARIES = {
    NewKind.deformation: "a line and sine waves for each Gaussian",
    NewKind.features: "one token a Gaussian, of place and time",
    NewKind.interaction: "objects follow the mean of the humans' tokens",
    NewKind.density: "removes what can hardly be seen",
    NewKind.reader: "a folder with scene.npz and images",
    NewKind.rasterizer: "plain torch, every splat at every pixel",
    NewKind.decoder: "colours that change with the time and the direction of view",
    NewKind.objective: "depth that is even where the picture is",
    NewKind.exporter: "a text file of positions and opacities for each moment",
}

# the command that uses a component, where it is not the training of a spec that names it
USAGES = {
    NewKind.reader: "hoigs train FOLDER        # reads {name}'s folders",
    NewKind.exporter: "hoigs plugins check exporter:{name}",
}


def new_plugin(
    name: Annotated[str, typer.Argument(help="Of the package and the component: acme-bounce.")],
    kind: Annotated[NewKind, typer.Option("--kind", help="What it offers.")] = NewKind.deformation,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Where the folder NAME is made.")
    ] = Path(),
) -> None:
    """Write a package of your own: a working component, its tests, an entry point, a README."""
    folder = write_package(name, kind, out)
    typer.echo(f"{folder}: {kind}:{name}, ready to install and to change:")
    typer.echo(f"  cd {folder}\n  pip install -e '.[test]'\n  pytest")
    typer.echo(f"  hoigs plugins show {kind}:{name}")
    if (folder / f"{name}.yaml").is_file():
        typer.echo(f"  hoigs train builtin:carry --spec {name}.yaml")
        command = f"hoigs study compare builtin:carry --specs hoigs,{name}.yaml"
        typer.echo(f"  {command} --budgets 300 --seeds 1")


def write_package(name: str, kind: NewKind, out: Path) -> Path:
    """Fill the templates of `kind` and put the package at `out`/`name`, whole or not at all.

    Raises:
        HoigsError: the name cannot be that of a package, or the folder is there already.
    """
    from hoigs.core.registry.component import API

    check_name(name, kind)
    folder = out / name
    if folder.exists() or folder.is_symlink():
        raise HoigsError(f"{folder} is there already and stays as it is; choose another name")
    words = {
        "name": name,
        "kind": kind.value,
        "key": f"{kind}:{name}",
        "module": name.replace("-", "_"),
        "cls": class_name(name),
        "api": str(API),
        "summary": SUMMARIES[kind],
        "usage": USAGES.get(kind, "hoigs train CLIP --spec {name}.yaml").format(name=name),
    }
    root = resources.files("hoigs.cli") / TEMPLATES
    out.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=out))
    try:
        made = scratch / name
        for part in ("common", kind.value):
            _fill(root / part, made, words)
        made.rename(folder)
    finally:
        shutil.rmtree(scratch)
    return folder


def check_name(name: str, kind: NewKind) -> None:
    """Raise HoigsError unless a distribution, a module, a class and a component can have `name`."""
    from hoigs.core.registry.registry import default_registry

    if not _NAME.fullmatch(name):
        near = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
        hint = f'; did you mean "{near}"?' if _NAME.fullmatch(near) else ""
        raise HoigsError(
            f'name "{name}": expected lower-case letters, digits and single dashes, a letter '
            f"first, for example acme-bounce{hint}"
        )
    module = name.replace("-", "_")
    if keyword.iskeyword(module) or module in sys.stdlib_module_names:
        raise HoigsError(f'name "{name}": Python has a {module} of its own; choose another name')
    for offer in default_registry().manager.offers:
        if offer.plugin.builtin and offer.key == f"{kind}:{name}":
            raise HoigsError(f"{kind}:{name} is built in and cannot be replaced; choose another")
    if importlib.util.find_spec(module) is not None:
        raise HoigsError(
            f'name "{name}": a module {module} is installed here already; choose another name'
        )
    cls = class_name(name)
    root = resources.files("hoigs.cli") / TEMPLATES / kind.value / "package"
    text = (root / f"{kind}.py{SUFFIX}").read_text(encoding="utf-8")
    if re.search(rf"\b{cls}(Config)?\b", text):
        raise HoigsError(f'name "{name}": the class would be {cls}, which the module imports')


def class_name(name: str) -> str:
    """acme-bounce -> AcmeBounce."""
    return "".join(part.capitalize() for part in name.split("-"))


def _fill(source: Traversable, target: Path, words: Mapping[str, str]) -> None:
    """Copy a folder of templates with `words` filled in; `package` becomes the module's name."""
    for entry in source.iterdir():
        if entry.is_dir():
            name = words["module"] if entry.name == "package" else entry.name
            _fill(entry, target / name, words)
        elif entry.name.endswith(SUFFIX):
            name = entry.name.removesuffix(SUFFIX)
            name = f"{words['name']}.yaml" if name == "spec.yaml" else name
            text = Template(entry.read_text(encoding="utf-8")).substitute(words)
            target.mkdir(parents=True, exist_ok=True)
            (target / name).write_text(text, encoding="utf-8")


plugins_app = typer.Typer(invoke_without_command=True)
plugins_app.command("check")(check_plugins)
plugins_app.command("new")(new_plugin)
plugins_app.command("show")(show_plugin)

# Fixed, so that one plugin's line never moves another's.
LINE = "{key:<34} {status:<12} {origin:<28} {text}"


@plugins_app.callback()
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


# `hoigs spec list|check|show|keys`: built-in specs and spec files.

spec_app = typer.Typer(help="List, check and show specs and their keys.", no_args_is_help=True)
NameOrFile = Annotated[
    str,
    typer.Argument(help="A built-in spec's name, or a .yaml or .toml file; @PROFILE may follow."),
]


@spec_app.command("list")
def list_specs() -> None:
    """Names and summaries of the built-in specs, and their profiles besides the native one."""
    from hoigs.core.spec.files import builtin_specs, builtin_summary, spec_profiles

    for name in builtin_specs():
        profiles = " ".join(f"@{profile}" for profile in spec_profiles(name)[1:])
        also = f" [{profiles}]" if profiles else ""
        typer.echo(f"{name:<24} {builtin_summary(name)}{also}")


@spec_app.command("check")
def check_spec(spec: NameOrFile, settings: SetOption = None, plugin: PluginOption = None) -> None:
    """Check a spec and all its profiles, and list its components."""
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.spec.files import spec_profiles
    from hoigs.core.spec.schema import require_fitting

    profiles = [f"{spec}@{profile}" for profile in spec_profiles(spec)[1:]]
    for loaded in [_load(one, settings, plugin) for one in (spec, *profiles)]:
        require_fitting(loaded, default_registry(plugin or ()))
        typer.echo(f"{loaded.name}: ok")
        for place, key in loaded.components().items():
            typer.echo(f"  {place:<28} {key}")


@spec_app.command("show")
def show_spec(spec: NameOrFile, settings: SetOption = None, plugin: PluginOption = None) -> None:
    """Print a spec with all defaults; the output is a spec."""
    typer.echo(_load(spec, settings, plugin).dump(), nl=False)


@spec_app.command("keys")
def spec_keys(
    under: Annotated[
        str, typer.Argument(help="List those below a key only: train.rates, model.human.")
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Every key of a spec with its type, default and meaning; those of a component are listed by
    `hoigs plugins show`."""
    from hoigs.core.registry.settings import describe_settings
    from hoigs.core.spec.schema import KINDS, EntitySpec, Spec

    rows = [asdict(row) for row in describe_settings(Spec)]
    for kind in KINDS:
        rows += [asdict(row) for row in describe_settings(EntitySpec, f"model.{kind}.")]
    found = [r for r in rows if not under or f"{r['name']}.".startswith(f"{under}.")]
    if not found:
        names = [r["name"] for r in rows]
        blocks = {n[:i] for n in names for i, c in enumerate(n) if c == "."}
        raise SpecError(f'no key "{under}"{did_you_mean(under, [*names, *blocks])}')
    typer.echo(json.dumps({"keys": found}, indent=1) if as_json else
               "\n".join(settings_lines(found)))  # fmt: skip


def _load(spec: str, settings: Sequence[str] | None, plugin: Sequence[Path] | None) -> Spec:
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.spec.schema import Spec

    return Spec.load(spec, overrides=settings or (), registry=default_registry(plugin or ()))


# `hoigs estimators`: the environments that estimators run in.

estimators_app = typer.Typer(
    help="Environments that estimators run in: list, install, remove.", no_args_is_help=True
)
Name = Annotated[str, typer.Argument(help="Environment, as `hoigs estimators list` names it.")]


@estimators_app.command("list")
@with_json
def list_environments() -> None:
    """List the environments, and whether they are installed."""
    from hoigs.core.registry.registry import known_environments

    rows = []
    for environment in known_environments().values():
        state = environment.description().get("versions") or "not installed"
        where = str(environment.folder) if environment.installed else ""
        rows.append((environment.name, state, environment.summary, where))
        rows += [("", f"lacks {name}", why, "") for name, why in environment.lacking().items()]
    print_table("environments of estimators", ("name", "state", "what", "folder"), rows)


@estimators_app.command("install")
def install_environment(name: Name) -> None:
    """Make an environment: download its packages, check their hashes, try it."""
    from hoigs.core.registry.registry import environment_named

    environment = environment_named(name)
    with Display() as show:
        environment.install(show.fraction)
    typer.echo(f"{name}: {environment.description()['versions']}, in {environment.folder}")
    for file, why in environment.lacking().items():
        typer.echo(f"warning: {file}: {why}", err=True)


@estimators_app.command("remove")
def remove_environment(name: Name) -> None:
    """Remove an environment and its downloads."""
    from hoigs.core.registry.registry import environment_named

    removed = environment_named(name).remove()
    typer.echo(f"{name} removed" if removed else f"{name} was not installed")
