"""The hooks that a plugin can implement, and the marker with which it does."""

from __future__ import annotations

from collections.abc import Iterable

import pluggy

from hoigs.core.registry.component import Component

PROJECT = "hoigs"

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def hoigs_components() -> Iterable[Component]:  # type: ignore[empty-body]
    """What this plugin offers. Called once; must be quick and import nothing heavy."""
