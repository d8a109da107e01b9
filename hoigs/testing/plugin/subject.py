"""PluginSubject: one component and the plugin that offers it; and conditions of checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hoigs.core.errors import PluginError
from hoigs.core.registry.component import Component
from hoigs.core.registry.manager import Offer, normal_name
from hoigs.core.registry.registry import Registry
from hoigs.testing.checks import CheckList

if TYPE_CHECKING:
    from hoigs.testing.runner import Options


@dataclass(frozen=True)
class PluginSubject:
    """The offer under check, in its registry."""

    offer: Offer
    registry: Registry
    options: Options

    def __str__(self) -> str:
        return self.offer.exact

    @property
    def component(self) -> Component:
        return self.offer.component

    def config_class(self) -> type[Any]:
        return self.registry.config_class(self.offer.exact)

    def config(self) -> Any:
        """Its settings: the given ones, and defaults for the others."""
        return self.config_class().model_validate(dict(self.options.settings))


CHECKS: CheckList[PluginSubject] = CheckList("P")


def subject(key: str, registry: Registry, options: Options) -> PluginSubject:
    """The offer of `key`, whatever its status.

    Raises:
        PluginError: no distribution offers it, or several do and `key` names none of them.
    """
    name, _, dist = key.partition("@")
    found = [o for o in registry.manager.offers if o.key == name]
    if dist:
        found = [o for o in found if normal_name(o.plugin.dist) == normal_name(dist)]
    builtin = [o for o in found if o.plugin.builtin]
    chosen = builtin or found
    if len(chosen) != 1:
        registry.component(key)  # raises with the nearest name
        raise PluginError(f"{key} is offered by {', '.join(o.exact for o in found)}; write one")
    return PluginSubject(chosen[0], registry, options)


def takes_settings(subject: PluginSubject) -> str | None:
    return None if subject.component.config is not None else "it declares no config"


def has_extra(subject: PluginSubject) -> str | None:
    return None if subject.component.extra is not None else "it declares no extra"


def installed(subject: PluginSubject) -> str | None:
    plugin = subject.offer.plugin
    return "it comes from a file" if plugin.version.startswith("sha256:") else None
