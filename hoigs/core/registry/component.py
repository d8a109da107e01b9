"""Component: what a plugin offers, as strings, so that listing it imports nothing heavy."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pluggy

from hoigs.core.errors import PluginError, did_you_mean

API = 1  # number of the plugin interface; increased when existing plugins would no longer work

# kind -> the interface from which its classes derive
INTERFACES: dict[str, str] = {
    "deformation": "hoigs.core.interfaces.deformation:DeformationModel",
    "features": "hoigs.core.interfaces.features:FeatureExtractor",
    "interaction": "hoigs.core.interfaces.interaction:InteractionModule",
    "rasterizer": "hoigs.core.interfaces.rasterizer:Rasterizer",
    "decoder": "hoigs.core.interfaces.decoder:Decoder",
    "body": "hoigs.core.interfaces.body:BodyModel",
    "reader": "hoigs.core.interfaces.reader:ClipReader",
    "density": "hoigs.core.interfaces.density:DensityControl",
    "initializer": "hoigs.core.interfaces.initializer:ObjectInitializer",
    "estimator": "hoigs.core.interfaces.estimator:Estimator",
    "exporter": "hoigs.core.model.exporter:Exporter",
    "objective": "hoigs.core.model.objective:Objective",
}
KINDS = tuple(INTERFACES)
_KEY = re.compile(r"[a-z]+:[a-z0-9]+(?:[-_.][a-z0-9]+)*")
_TARGET = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class Component:
    """One class that a spec can name.

    Attributes:
        key: "kind:name", kind one of KINDS, name in lower case with dashes.
        target: "package.module:Class", imported on first use.
        config: "package.module:Config", a ComponentConfig; None when there is nothing to set.
        api: number of the plugin interface that it was written for.
        summary: one line for listings.
        extra: name of the distribution's extra that it needs, for example "viewer".
    """

    key: str
    target: str
    config: str | None = None
    api: int = API
    summary: str = ""
    extra: str | None = None

    @property
    def kind(self) -> str:
        return self.key.partition(":")[0]

    def check_types(self) -> None:
        """Raise PluginError when a field is not text, as listings need."""
        for field in ("key", "target", "config", "summary", "extra"):
            value = getattr(self, field)
            if not isinstance(value, str) and not (value is None and field in ("config", "extra")):
                raise PluginError(f"hoigs.Component: {field} is {value!r}, expected a str")

    def check(self) -> None:
        """Raise PluginError when a field is invalid."""
        kind = self.kind
        if not _KEY.fullmatch(self.key):
            raise PluginError(
                f'component key "{self.key}": expected "kind:name" in lower case, for example '
                '"deformation:b-spline"'
            )
        if kind not in INTERFACES:
            raise PluginError(
                f'component key "{self.key}": unknown kind "{kind}"{did_you_mean(kind, KINDS)} '
                f"(kinds: {', '.join(KINDS)})"
            )
        for field in ("target", "config"):
            value = getattr(self, field)
            if value is not None and not _TARGET.fullmatch(value):
                raise PluginError(
                    f'{self.key}: {field} is "{value}", expected "package.module:Class"'
                )


def missing_target(target: str, *, read: bool = True) -> str | None:
    """Why `target` cannot exist, or None; reads source files but imports nothing.

    Args:
        read: False looks for the module's file only.

    Modules that are not plain source, and names that a module makes in ways that its text does
    not show, are taken to exist.
    """
    module, _, name = target.partition(":")
    path = _source_of(module)
    if isinstance(path, str):
        return path
    if path is None or not read:
        return None
    try:
        names, packages = _outline(path)
    except SyntaxError as error:
        return f"SyntaxError in {path.name}, line {error.lineno}: {error.msg}"
    for package in packages:
        if importlib.util.find_spec(package) is None:
            return f'{path.name} imports "{package}", which is not installed'
    if name in names or names & {"*", "__getattr__"}:
        return None
    return f'module "{module}" has no "{name}"{did_you_mean(name, names)}'


def _source_of(module: str) -> Path | str | None:
    """The module's source file; or a str with the reason why it has none; None if unreadable."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top)  # a top-level name: found without being imported
    if spec is None:
        return f'no module "{module}"'
    if not rest:
        return Path(spec.origin) if spec.origin and spec.origin.endswith(".py") else None
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    for part in rest[:-1]:
        folders = [folder / part for folder in folders if (folder / part).is_dir()]
    for folder in folders:
        for path in (folder / rest[-1] / "__init__.py", folder / f"{rest[-1]}.py"):
            if path.is_file():
                return path
        if next(folder.glob(f"{rest[-1]}.*"), None):
            return None  # an extension module
    return f'no module "{module}"'


@cache
def _outline(path: Path) -> tuple[set[str], set[str]]:
    """Names that a module binds, and packages without which it cannot be imported: those that it
    imports outside of any `if` or `try`."""
    names: set[str] = set()
    packages: set[str] = set()
    for statement in ast.parse(path.read_bytes(), filename=str(path)).body:
        if isinstance(statement, ast.Import):
            packages.update(alias.name.partition(".")[0] for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom) and statement.level == 0 and statement.module:
            packages.add(statement.module.partition(".")[0])
        if isinstance(statement, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names.add(statement.name)
            continue
        for node in ast.walk(statement):
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
            elif isinstance(node, ast.Import | ast.ImportFrom):
                names.update(alias.asname or alias.name for alias in node.names)
    return names, packages


# The hooks that a plugin can implement, and the marker with which it does.


PROJECT = "hoigs"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def hoigs_components() -> Iterable[Component]:  # type: ignore[empty-body]
    """What this plugin offers. Called once; must be quick and import nothing heavy."""
