"""Registry: maps the keys of components, for example "deformation:chs", to classes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from hoigs.core.errors import HoigsError, PluginError, did_you_mean
from hoigs.core.registry.component import INTERFACES, KINDS, Component, missing_target
from hoigs.core.registry.import_watch import limited, traceback_tail
from hoigs.core.registry.manager import Offer, PluginManager, Status, describe, normal_name
from hoigs.core.system.environments import ManagedEnvironment


class UsesComponents(Protocol):
    """The part of a spec that the registry needs: the keys that it names, by place."""

    def components(self) -> Mapping[str, str]: ...


class Registry:
    """The components of a plugin manager, by key.

    Args:
        manager: with its plugins loaded.
    """

    def __init__(self, manager: PluginManager) -> None:
        self.manager = manager

    def keys(self, kind: str | None = None) -> list[str]:
        """Keys that can be used without "@dist", of one kind or of all."""
        usable = {o.key for o in self.manager.offers if o.status is Status.OK}
        return sorted(k for k in usable if kind is None or k.partition(":")[0] == kind)

    def component(self, key: str) -> Component:
        """The declaration of `key`, without importing its class.

        Raises:
            PluginError: unknown, broken, conflicting, blocked, incompatible or lacking an extra.
        """
        return self._offer(key).component

    def get(self, key: str) -> type[Any]:
        """The class of `key` ("kind:name", or "kind:name@dist"), imported.

        Raises:
            PluginError: as `component`, or it cannot be imported, or it does not derive from the
                interface of its kind.
        """
        offer = self._offer(key)
        loaded = self._load(offer, offer.component.target)
        interface = INTERFACES[offer.component.kind]
        if not (isinstance(loaded, type) and issubclass(loaded, _import(interface))):
            self._break(
                offer,
                f"{offer.component.target} is {_what(loaded)}, expected a subclass of "
                f"{interface.replace(':', '.')}",
            )
        return loaded

    def concrete(self, key: str) -> type[Any]:
        """The class of `key`, to be built.

        Raises:
            PluginError: as `get`, or it lacks methods of its interface.
        """
        loaded = self.get(key)
        if missing := ", ".join(sorted(getattr(loaded, "__abstractmethods__", ()))):
            offer = self._offer(key)
            interface = INTERFACES[offer.component.kind].replace(":", ".")
            self._break(offer, f"{offer.component.target} lacks {missing} of {interface}")
        return loaded

    def config_class(self, key: str) -> type[Any]:
        """The ComponentConfig class of `key`; one without settings has the bare class.

        Raises:
            PluginError: as `get`.
        """
        from hoigs.core.config import ComponentConfig  # on use: pydantic slows listings

        offer = self._offer(key)
        if offer.component.config is None:
            return ComponentConfig
        loaded = self._load(offer, offer.component.config)
        if not (isinstance(loaded, type) and issubclass(loaded, ComponentConfig)):
            self._break(
                offer,
                f"{offer.component.config} is {_what(loaded)}, expected a subclass of "
                "hoigs.core.config.ComponentConfig",
            )
        if "use" in loaded.model_fields:
            self._break(offer, f'{offer.component.config} has a field "use", which specs reserve')
        return loaded

    def origin(self, key: str) -> dict[str, str]:
        """Where a component comes from: its exact key, distribution, version and target."""
        offer = self._offer(key)
        return {
            "key": offer.exact,
            "dist": offer.plugin.dist,
            "version": offer.plugin.version,
            "target": offer.component.target,
        }

    def provenance(self, spec: UsesComponents) -> dict[str, dict[str, str]]:
        """The origin of each component that a spec uses, by its place in the spec."""
        return {place: self.origin(key) for place, key in spec.components().items()}

    def check(self, offer: Offer) -> None:
        """Look for an offer's targets on disk, importing nothing, and mark it when absent."""
        for target in (offer.component.target, offer.component.config):
            if offer.status is Status.OK and target is not None:
                try:
                    # tests import all built-in components; reading their files would take 0.1 s
                    problem = missing_target(target, read=not offer.plugin.builtin)
                except Exception as error:  # a file that cannot be read, a finder that raises
                    problem = describe(error)
                if problem:
                    offer.fail(Status.BROKEN, f"cannot import {target}: {problem}")

    def try_loading(self, offer: Offer) -> None:
        """Import an offer's class and config, and mark it when that fails."""
        if offer.status is not Status.OK:
            return
        try:
            self.concrete(offer.exact)
            self.config_class(offer.exact)
        except PluginError as error:
            if offer.status is Status.OK:
                offer.fail(Status.BROKEN, str(error))

    def _offer(self, key: str) -> Offer:
        name, at, dist = key.partition("@")
        offers = [o for o in self.manager.offers if o.key == name]
        if at:
            named = [o for o in offers if normal_name(o.plugin.dist) == normal_name(dist)]
            if offers and not named:
                spellings = " or ".join(o.exact for o in offers)
                raise PluginError(f'{name} is not offered by "{dist}"; write {spellings}')
            usable = [o for o in named if o.status in (Status.OK, Status.CONFLICT)]
            if len(usable) == 1:
                return usable[0]
            offers = named
        usable = [o for o in offers if o.status is Status.OK]
        if len(usable) == 1:
            return usable[0]
        if offers:
            # a built-in key that a plugin offers too is usable, and does not come here
            raise PluginError("; ".join(dict.fromkeys(f"{o.status}: {o.error}" for o in offers)))
        raise PluginError(self._unknown(name))

    def _unknown(self, key: str) -> str:
        kind, colon, _ = key.partition(":")
        if not colon:
            near = [k for k in self.keys() if k.partition(":")[2] == key]
            hint = f'; did you mean "{near[0]}"?' if near else did_you_mean(key, self.keys())
            return f'"{key}" is no component key, expected "kind:name"{hint}'
        if kind not in INTERFACES:
            return f'no component "{key}": unknown kind "{kind}"{did_you_mean(kind, KINDS)}'
        others = [k for k in self.keys() if not k.startswith(f"{kind}:")]
        hint = did_you_mean(key, self.keys(kind)) or did_you_mean(key, others)
        known = ", ".join(self.keys(kind)) or "none"
        failed = [p for p in self.manager.plugins if p.status is not Status.OK]
        names = ", ".join(f"{p.dist} ({p.status})" for p in failed)
        hidden = f"; plugins that could not offer anything: {names}" if failed else ""
        return f'no component "{key}"{hint} (known: {known}){hidden}'

    def _load(self, offer: Offer, target: str) -> Any:
        try:
            with ExitStack() as stack:
                # stdout belongs to the command, and may be JSON
                stack.enter_context(redirect_stdout(sys.stderr))
                if not offer.plugin.builtin:
                    stack.enter_context(limited(f"{offer.exact} ({target})", offer.plugin.dist))
                return _import(target)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a plugin may raise anything
            extra = offer.component.extra
            hint = f"; pip install '{offer.plugin.dist}[{extra}]'" if extra else ""
            needs_extra = extra is not None and isinstance(error, ImportError)
            reason = f"{offer.exact}: cannot import {target}: {describe(error)}{hint}"
            status = Status.NEEDS_EXTRA if needs_extra else Status.BROKEN
            offer.fail(status, reason, traceback_tail(error))
            raise PluginError(reason) from error

    def _break(self, offer: Offer, reason: str) -> None:
        offer.fail(Status.BROKEN, f"{offer.exact}: {reason}")
        raise PluginError(offer.error)


def _import(target: str) -> Any:
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


def _what(value: Any) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"


@cache
def _installed() -> Registry:
    manager = PluginManager()
    manager.load_installed()
    return Registry(manager)


def default_registry(plugin_files: Iterable[str | Path] = ()) -> Registry:
    """The registry of this process, made on first use from what is installed.

    Args:
        plugin_files: plugins that the user named (`--plugin FILE`); they stay loaded.
    """
    registry = _installed()
    for path in plugin_files:
        registry.manager.load_file(path)
    return registry


# The environments that the installed estimators name.


def known_environments(registry: Registry | None = None) -> dict[str, ManagedEnvironment]:
    """By name; estimators that lack an extra are passed over."""
    registry = registry or default_registry()
    found = {}
    for key in registry.keys("estimator"):
        try:
            environment = registry.get(key).environment
        except PluginError:
            continue
        if environment is not None:
            found[environment.name] = environment
    return found


def environment_named(name: str, registry: Registry | None = None) -> ManagedEnvironment:
    """One of them.

    Raises:
        HoigsError: there is no such environment.
    """
    known = known_environments(registry)
    if name not in known:
        raise HoigsError(
            f"there is no environment {name!r}{did_you_mean(name, known)}; there are: "
            f"{', '.join(known) or 'none'}"
        )
    return known[name]
