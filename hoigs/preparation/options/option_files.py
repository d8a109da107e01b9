"""Options of `prepare` from a file and from KEY=VALUE settings, and the estimators that they
name."""

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
from hoigs.core.spec.loader import Document, load_overrides, read_document
from hoigs.preparation.options.prepare_options import Place, PrepareOptions

_OPTIONS = {"preset": "estimators"}  # whose names on the command line are others


def load_options(
    file: PrepareOptions | Path | str | None = None,
    settings: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
    registry: Registry | None = None,
) -> PrepareOptions:
    """Options from a YAML or TOML file, or ready-made, with settings and flags laid over them.

    Args:
        settings: "estimators.masks.use=estimator:masks-files".
        flags: options by name; None leaves one alone.

    Raises:
        SpecError: everything that is wrong, a line each, with its position.
    """
    if isinstance(file, PrepareOptions):
        document = Document("options", file.model_dump(mode="json"))
    else:
        document = Document("options") if file is None else read_document(Path(file))
    given = {name: value for name, value in (flags or {}).items() if value is not None}
    places: dict[tuple[str | int, ...], str] = {
        (name,): f"--{_OPTIONS.get(name, name).replace('_', '-')}" for name in given
    }
    document = document.merged(Document("command line", given, dict(places), dict(places)))
    if settings:
        document = document.merged(load_overrides(list(settings)))
    try:
        options = PrepareOptions.model_validate(document.data)
    except ValidationError as error:
        raise SpecError("\n".join(explain(error, PrepareOptions, document, ()))) from error
    installed_estimators(
        options, document, registry
    )  # so that errors in them are reported at once, too
    return options


def installed_estimators(
    options: PrepareOptions, document: Document | None = None, registry: Registry | None = None
) -> dict[Place, Estimator]:
    """The estimators that `options.estimators` names, built from their plugins.

    Args:
        document: where the options came from, for messages.

    Raises:
        SpecError: an estimator is unknown, gives something else, or its settings are wrong.
    """
    registry = registry or default_registry()
    document = document or Document("options", options.model_dump(mode="json"))
    estimators: dict[Place, Estimator] = {}
    problems: list[str] = []
    for role, spec in options.estimators.items():
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
