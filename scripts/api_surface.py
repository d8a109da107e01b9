"""The public surface of hoigs as text: every name with its arguments, a line each.

    python scripts/api_surface.py > docs/api-surface.txt

Users rely on these names. A line that is removed or changed breaks their code: keep the old name
working for a release, with a DeprecationWarning, and describe the change in changelog.d/.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from enum import Enum
from typing import Any

# beside the names of `hoigs` itself: what plugins import
MODULES = (
    "hoigs.core.config",
    "hoigs.core.interfaces.context",
    "hoigs.core.interfaces.deformation",
    "hoigs.core.interfaces.density",
    "hoigs.core.errors",
    "hoigs.core.interfaces.estimator",
    "hoigs.core.model.exporter",
    "hoigs.core.interfaces.features",
    "hoigs.core.interfaces.initializer",
    "hoigs.core.interfaces.interaction",
    "hoigs.core.interfaces.rasterizer",
    "hoigs.core.interfaces.reader",
    "hoigs.core.reporting",
    "hoigs.core.registry.registry",
    "hoigs.core.values.topology",
    "hoigs.gsplat",
    "hoigs.metrics",
    "hoigs.testing",
)


def surface() -> list[str]:
    """Sorted lines."""
    import hoigs

    lines: set[str] = set()
    for name in hoigs._PUBLIC:
        lines.update(_lines(f"hoigs.{name}", getattr(hoigs, name)))
    for path in MODULES:
        module = importlib.import_module(path)
        for name, value in vars(module).items():
            public = name in getattr(module, "__all__", [name])
            own = getattr(value, "__module__", "").startswith(path)
            if public and own and not name.startswith("_"):
                lines.update(_lines(f"{path}.{name}", value))
    return sorted(lines)


def _lines(name: str, value: Any) -> Iterator[str]:
    if not inspect.isclass(value):
        yield f"{name}{_arguments(value)}"
        return
    yield f"{name}{_arguments(value)}"
    for key, member in vars(value).items():
        if key.startswith("_"):
            continue
        if isinstance(member, staticmethod | classmethod):
            yield f"{name}.{key}{_arguments(getattr(value, key))}"
        elif inspect.isfunction(member):
            yield f"{name}.{key}{_arguments(member)}"
        elif isinstance(member, property):
            yield f"{name}.{key}"


def _arguments(value: Any) -> str:
    """(name, other=default) without types; defaults that are objects are shown as ..."""
    if isinstance(value, type) and issubclass(value, Enum):  # whose signature is Python's own
        return f"({', '.join(value.__members__)})"
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return ""
    plain = (type(None), bool, int, float, str, tuple, frozenset)
    shown = [
        p.replace(
            annotation=p.empty,
            default=p.default if p.default is p.empty or type(p.default) in plain else ...,
        )
        for p in parameters
    ]
    return str(inspect.Signature(shown)).replace("Ellipsis", "...")


if __name__ == "__main__":
    print("\n".join(surface()))
