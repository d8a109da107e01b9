"""The estimators that options name, built from the installed plugins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hoigs.core.errors import PluginError, SpecError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.estimator import EstimateKind, Estimator
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document
from hoigs.core.spec.schema import ComponentSpec
from hoigs.preparation.options import Place, PrepareOptions


def installed_estimators(
    specs: Mapping[Place, ComponentSpec],
    document: Document | None = None,
    registry: Registry | None = None,
) -> dict[Place, Estimator]:
    """The estimators that specs name, built from their plugins.

    Args:
        document: where the specs came from, under `estimators`, for messages.

    Raises:
        SpecError: an estimator is unknown, gives something else, or its settings are wrong.
    """
    registry = registry or default_registry()
    if document is None:
        data = {role: spec.model_dump(mode="json") for role, spec in specs.items()}
        document = Document("options", {"estimators": data})
    estimators: dict[Place, Estimator] = {}
    problems: list[str] = []
    for role, spec in specs.items():
        kind: EstimateKind = "masks" if role == "object" else role
        place = ("estimators", role)
        at = f"{document.where((*place, 'use'))} estimators.{role}.use"
        try:
            component = registry.concrete(spec.use)
            config_class = registry.config_class(spec.use)
        except PluginError as error:
            problems.append(f"{at}: {error}")
            continue
        if not issubclass(component, Estimator) or kind not in component.provides:
            problems.append(
                f'{at}: "{spec.use}" gives no {kind} of a video; those that do: '
                f"{', '.join(_givers(registry, kind)) or 'none is installed'}"
            )
            continue
        try:
            config = config_class.model_validate(spec.settings)
        except ValidationError as error:
            problems += explain(error, config_class, document, place)
            continue
        estimators[role] = component.from_config(config, BuildContext())
    if problems:
        raise SpecError("\n".join(problems))
    return estimators


def refuse_commands(estimators: Mapping[Place, Estimator]) -> None:
    """SpecError, showing the command lines, if estimators would run programs."""
    lines = [
        f"  estimators.{kind}: {c}"
        for kind, estimator in estimators.items()
        for c in estimator.commands()
    ]
    if lines:
        found = "\n".join(lines)
        raise SpecError(
            f"these options run programs on this machine:\n{found}\n"
            "nothing was run; if you trust them, use --allow-commands (prepare(..., "
            "allow_commands=True))"
        )


def _givers(registry: Registry, kind: EstimateKind) -> list[str]:
    """Keys of the installed estimators that give a kind of estimate."""
    found = []
    for key in registry.keys("estimator"):
        try:
            component = registry.get(key)
        except PluginError:  # one that lacks an extra cannot be chosen now
            continue
        if issubclass(component, Estimator) and kind in component.provides:
            found.append(key)
    return found


def load_options(
    file: PrepareOptions | Path | str | None = None,
    settings: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
) -> PrepareOptions:
    """`PrepareOptions.of`, whose estimators are installed; a flag that is None changes nothing.

    Raises:
        SpecError: everything that is wrong with the options, or with their estimators.
    """
    given = {name: value for name, value in (flags or {}).items() if value is not None}
    options = PrepareOptions.of(file, {**given, "overrides": tuple(settings)})
    installed_estimators(options.estimators, options.document)
    return options
