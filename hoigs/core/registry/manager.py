"""PluginManager: finds plugins, collects the components of each, and records every failure.

pluggy's own `load_setuptools_entrypoints` stops at the first plugin that fails and ignores a
second one of the same name. Here each is loaded in its own `try`, and failures become a status.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import nullcontext, redirect_stdout, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import metadata
from itertools import islice
from pathlib import Path

import pluggy

from hoigs.core.errors import PluginError, did_you_mean
from hoigs.core.registry import component as hookspecs
from hoigs.core.registry.component import API, Component
from hoigs.core.registry.import_watch import limited, traceback_tail, watched

# Extras of a distribution: their requirements, and which of these are not installed.

_EXTRA = re.compile(r"extra\s*==\s*['\"]([^'\"]+)['\"]")


def missing_requirements(dist: str, extra: str | None) -> list[str]:
    """Distributions that an extra of `dist` requires and that are not installed."""
    if extra is None:
        return []
    missing = []
    for line in _requirements(dist):
        requirement, _, marker = line.partition(";")
        name = re.match(r"[A-Za-z0-9._-]+", requirement.strip())
        if name is None or extra not in _EXTRA.findall(marker):
            continue
        try:
            metadata.version(name[0])
        except metadata.PackageNotFoundError:
            missing.append(name[0])
    return missing


def declared_extras(dist: str) -> set[str]:
    """Extras that any requirement of `dist` belongs to."""
    return {extra for line in _requirements(dist) for extra in _EXTRA.findall(line)}


def _requirements(dist: str) -> list[str]:
    try:
        return metadata.requires(dist) or []
    except metadata.PackageNotFoundError:
        return []  # a plugin file has no metadata; missing requirements show at its import


GROUP = "hoigs"
HOOK = "hoigs_components"
BUILTIN_MODULE = "hoigs.plugins.builtin"
MOST = 1000  # components of one plugin: a hook that yields without end must not stop the others


class Status(StrEnum):
    """The status of a plugin or a component."""

    OK = "ok"
    BROKEN = "broken"  # it raised, or its declaration is invalid
    CONFLICT = "conflict"  # another plugin offers the same key
    BLOCKED = "blocked"  # by HOIGS_PLUGINS or HOIGS_BLOCK
    INCOMPATIBLE = "incompatible"  # written for another version of the plugin interface
    NEEDS_EXTRA = "needs-extra"  # an optional dependency is not installed


@dataclass
class Plugin:
    """One module that offers components.

    Attributes:
        name: of its entry point, or of its file. module: where it is imported from.
        dist, version: of the distribution that it came with; of a file, its file name and hash.
        status, error: its status, and the reason. traceback: the innermost frames, if it raised.
        seconds: duration of its import and its hook. remarks: on side effects of its import.
    """

    name: str
    module: str
    dist: str
    version: str
    status: Status = Status.OK
    error: str = ""
    traceback: str = ""
    seconds: float = 0.0
    remarks: list[str] = field(default_factory=list)

    @property
    def builtin(self) -> bool:
        return self.module == BUILTIN_MODULE and self.dist == "hoigs"

    def fail(self, status: Status, error: str, traceback: str = "") -> None:
        self.status, self.error, self.traceback = status, error, traceback


@dataclass
class Offer:
    """One component of one plugin, and its status."""

    component: Component
    plugin: Plugin
    status: Status = Status.OK
    error: str = ""
    traceback: str = ""

    @property
    def key(self) -> str:
        return self.component.key

    @property
    def exact(self) -> str:
        """The key that names this offer alone: `kind:name@dist`."""
        return f"{self.key}@{self.plugin.dist}"

    def fail(self, status: Status, error: str, traceback: str = "") -> None:
        self.status, self.error, self.traceback = status, error, traceback


class PluginManager(pluggy.PluginManager):
    """Plugins of one process. Tests make their own; others use `registry.default_registry()`.

    Args:
        environ: where HOIGS_PLUGINS (allowed distributions or entry points, comma separated; "0"
            for the built-in ones only), HOIGS_BLOCK (those, or component keys, that are not to be
            used) and HOIGS_STRICT ("1": any failure raises) are read; by default os.environ.

    Attributes:
        plugins: every plugin found, also those that failed or are blocked.
        offers: every component found, in the order in which it was offered.
        notes: remarks on the settings, for listings.
    """

    def __init__(self, environ: Mapping[str, str] | None = None) -> None:
        super().__init__(hookspecs.PROJECT)
        self.add_hookspecs(hookspecs)
        environ = os.environ if environ is None else environ
        self.allowed = _names(environ.get("HOIGS_PLUGINS", "")) or None
        self.blocked = _names(environ.get("HOIGS_BLOCK", ""))
        self.strict = environ.get("HOIGS_STRICT", "0") not in ("", "0")
        self.plugins: list[Plugin] = []
        self.offers: list[Offer] = []
        self.notes: list[str] = []

    def load_installed(self, entry_points: Iterable[metadata.EntryPoint] | None = None) -> None:
        """Load the plugins of all installed distributions, or the given entry points.

        Raises:
            PluginError: with HOIGS_STRICT, when any of them is not in order.
        """
        found = metadata.entry_points(group=GROUP) if entry_points is None else entry_points
        for entry in found:
            plugin = Plugin(entry.name, entry.value, *_origin(entry))
            self.plugins.append(plugin)
            reason = self._blocked_reason(plugin)
            if reason:
                plugin.fail(Status.BLOCKED, reason)
                continue
            what = f"plugin {plugin.name} of {plugin.dist} ({plugin.module})"
            guard = nullcontext() if plugin.builtin else limited(what, plugin.dist)
            with guard, watched() as seen:
                self._load(plugin, entry)
            plugin.seconds = seen.seconds
            plugin.remarks = [] if plugin.builtin else seen.remarks()
        self._settle()
        self._check_settings()

    def load_file(self, path: str | Path) -> None:
        """Load a plugin from a Python file that the user named; it may use `__name__` in targets.

        Raises:
            PluginError: the file is absent or is not a working plugin.
        """
        path = Path(path).resolve()
        if path.suffix != ".py" or not path.is_file():
            raise PluginError(f"--plugin {path}: expected an existing Python file")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        name = f"hoigs_plugin_{re.sub(r'[^0-9a-zA-Z_]', '_', path.stem)}_{digest}"
        if any(p.module == name for p in self.plugins):
            return
        plugin = Plugin(path.stem, name, path.name, f"sha256:{digest}")
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # targets are imported by this name
        try:
            with limited(f"--plugin {path}", None), redirect_stdout(sys.stderr):
                spec.loader.exec_module(module)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            del sys.modules[name]
            raise PluginError(f"--plugin {path}: {describe(error)}") from error
        self.plugins.append(plugin)
        self._take(plugin, module)
        if plugin.status is not Status.OK:
            self.plugins.remove(plugin)
            raise PluginError(f"--plugin {path}: {plugin.error}")
        self._settle()

    def failures(self) -> list[str]:
        """One line for each plugin and component that failed.

        Blocked ones and those whose extra is not installed are not failures.
        """
        fine = (Status.OK, Status.BLOCKED, Status.NEEDS_EXTRA)
        lines = [
            f"{p.dist} ({p.name}): {p.status}: {p.error}"
            for p in self.plugins
            if p.status not in fine
        ]
        return lines + [
            f"{o.exact}: {o.status}: {o.error}" for o in self.offers if o.status not in fine
        ]

    def _load(self, plugin: Plugin, entry: metadata.EntryPoint) -> None:
        """Import the module of an entry point and take what it offers."""
        try:
            module = entry.load()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a plugin may raise anything
            reason = f"cannot load {entry.value}: {describe(error)}"
            plugin.fail(Status.BROKEN, reason, traceback_tail(error))
            return
        self._take(plugin, module)

    def _take(self, plugin: Plugin, module: object) -> None:
        """Register `module` and collect what it offers; all or nothing."""
        full_name = f"{plugin.dist}:{plugin.name}"
        try:
            if self.has_plugin(full_name):
                raise PluginError(f'{plugin.dist} has two entry points "{plugin.name}"')
            if self.is_registered(module):
                raise PluginError(f"{plugin.module} is already the plugin {self.get_name(module)}")
            self.register(module, name=full_name)
            problem = self._hook_problem(module)
            if problem:
                raise PluginError(problem)
            others = [p for p in self.get_plugins() if p is not module]
            answers = self.subset_hook_caller(HOOK, others)()
            components = [c for answer in answers for c in islice(answer, MOST + 1)]
            if len(components) > MOST:
                raise PluginError(f"{HOOK} yielded more than {MOST} components")
            for component in components:
                if not isinstance(component, Component):
                    raise PluginError(
                        f"{HOOK} yielded {component!r}, expected hoigs.Component(...)"
                    )
                component.check_types()
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            if self.get_plugin(full_name) is module:
                self.unregister(name=full_name)
            tail = "" if isinstance(error, PluginError) else traceback_tail(error)
            plugin.fail(Status.BROKEN, describe(error), tail)
            return
        self.offers.extend(Offer(component, plugin) for component in components)

    def _hook_problem(self, module: object) -> str | None:
        """A misspelt hook, or a hook that lacks its marker."""
        known = [name for name in vars(self.hook) if getattr(self.hook, name).has_spec()]
        for caller in self.get_hookcallers(module) or []:
            impl = next(i for i in caller.get_hookimpls() if i.plugin is module)
            if not caller.has_spec() and not impl.optionalhook:
                return f'unknown hook "{caller.name}"{did_you_mean(caller.name, known)}'
            if impl.wrapper or impl.hookwrapper:
                return f"{caller.name} is marked as a wrapper; mark it with @hoigs.hookimpl alone"
        if any(c.name == HOOK for c in self.get_hookcallers(module) or []):
            return None
        if hasattr(module, HOOK):
            return f"{HOOK} is not marked with @hoigs.hookimpl"
        public = [name for name in vars(module) if not name.startswith("__")]
        return f"it has no function {HOOK}{did_you_mean(HOOK, public)}"

    def _blocked_reason(self, plugin: Plugin) -> str | None:
        """Why a plugin is not even imported, or None."""
        names = {normal_name(plugin.dist), normal_name(plugin.name)}
        if names & self.blocked:
            return "named in HOIGS_BLOCK"
        if self.allowed is None or plugin.builtin or names & self.allowed:
            return None
        if self.allowed == {"0"}:
            return "HOIGS_PLUGINS=0 allows only the built-in plugins"
        return "not named in HOIGS_PLUGINS"

    def _settle(self) -> None:
        """Give every offer its status: each by itself first, then those with the same key."""
        for offer in self.offers:
            offer.status, offer.error = Status.OK, ""
            self._settle_offer(offer)
        rivals: dict[str, list[Offer]] = defaultdict(list)
        for offer in self.offers:
            if offer.status in (Status.OK, Status.NEEDS_EXTRA):
                rivals[offer.key].append(offer)
        for key, offers in rivals.items():
            _settle_key(key, offers)

    def _settle_offer(self, offer: Offer) -> None:
        component = offer.component
        if component.api != API:
            offer.fail(
                Status.INCOMPATIBLE,
                f"{offer.exact} was written for plugin interface {component.api}, this hoigs has "
                f"{API}; install versions of {offer.plugin.dist} and hoigs that agree",
            )
            return
        try:
            component.check()
        except PluginError as error:
            offer.fail(Status.BROKEN, str(error))
            return
        if {normal_name(offer.key), normal_name(offer.exact)} & self.blocked:
            offer.fail(Status.BLOCKED, f"{offer.exact} is named in HOIGS_BLOCK")
            return
        extras = set() if offer.plugin.builtin else declared_extras(offer.plugin.dist)
        if component.extra is not None and extras and component.extra not in extras:
            offer.fail(
                Status.BROKEN,
                f'{offer.exact}: {offer.plugin.dist} has no extra "{component.extra}"'
                f"{did_you_mean(component.extra, extras)}",
            )
            return
        missing = missing_requirements(offer.plugin.dist, component.extra)
        if missing:
            offer.fail(
                Status.NEEDS_EXTRA,
                f"{offer.key} needs {', '.join(missing)}: "
                f"pip install '{offer.plugin.dist}[{component.extra}]'",
            )

    def _check_settings(self) -> None:
        """Note names in HOIGS_PLUGINS and HOIGS_BLOCK that match nothing; raise when strict."""
        known = {normal_name(n) for p in self.plugins for n in (p.dist, p.name)}
        keys = {normal_name(n) for o in self.offers for n in (o.key, o.exact)}
        for variable, names, valid in (
            ("HOIGS_PLUGINS", (self.allowed or set()) - {"0"}, known),
            ("HOIGS_BLOCK", self.blocked, known | keys),
        ):
            for name in sorted(names - valid):
                self.notes.append(
                    f'{variable} names "{name}", which is not installed{did_you_mean(name, valid)}'
                )
        problems = self.failures() + self.notes
        if self.strict and problems:
            raise PluginError("HOIGS_STRICT: " + "\n".join(problems))


def _settle_key(key: str, offers: list[Offer]) -> None:
    """Refuse a key that several plugins offer; a built-in component keeps its key."""
    if len(offers) == 1:
        return
    builtin = [o for o in offers if o.plugin.builtin]
    dists = sorted({o.plugin.dist for o in offers})
    for offer in offers:
        if len(builtin) == 1 and len(dists) > 1:
            if offer is builtin[0]:
                continue
            reason = f"{key} is built in and cannot be shadowed; write {offer.exact} for this one"
        elif len(dists) == 1:
            reason = f"{key} is offered {len(offers)} times by {dists[0]}"
        else:
            spellings = " or ".join(f"{key}@{dist}" for dist in dists)
            reason = f"{key} is offered by {' and '.join(dists)}; write {spellings}"
        offer.fail(Status.CONFLICT, reason)


def _origin(entry: metadata.EntryPoint) -> tuple[str, str]:
    """Distribution and version of an entry point; "unknown" where its metadata is damaged."""
    with suppress(Exception):  # what a damaged METADATA raises differs between versions of Python
        dist = entry.dist
        if dist is not None:
            return str(dist.name or "unknown"), str(dist.version or "unknown")
    return "unknown", "unknown"


def describe(error: BaseException) -> str:
    """`Type: message` of an exception, on one line."""
    text = " ".join(str(error).split())
    kind = type(error).__name__
    if isinstance(error, PluginError):
        return text
    return f"{kind}: {text}" if text else kind


def normal_name(name: str) -> str:
    """Distribution names compare without case, and with - _ . alike (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _names(text: str) -> set[str]:
    return {normal_name(part.strip()) for part in text.split(",") if part.strip()}
