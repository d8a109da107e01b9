"""The environments that the installed estimators name."""

from __future__ import annotations

from hoigs.core.environments.managed import ManagedEnvironment
from hoigs.core.errors import HoigsError, PluginError, did_you_mean
from hoigs.core.registry.registry import Registry, default_registry


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
