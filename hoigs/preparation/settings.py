"""Options of `prepare` from a file and from KEY=VALUE settings, and the priors that they name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hoigs.core.context import BuildContext
from hoigs.core.errors import PluginError, SpecError
from hoigs.core.registry import Registry, default_registry
from hoigs.core.spec_errors import explain
from hoigs.core.spec_loader import Document, load_overrides, read_document
from hoigs.core.video_prior import EvidenceKind, VideoPrior
from hoigs.preparation.options import PrepareOptions


def load_options(
    file: Path | None = None,
    settings: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
    registry: Registry | None = None,
) -> PrepareOptions:
    """Options from a YAML or TOML file, with settings and flags laid over it.

    Args:
        settings: "priors.masks.use=prior:masks-files".
        flags: options by name; None leaves one alone.

    Raises:
        SpecError: everything that is wrong, a line each, with its position.
    """
    document = read_document(file) if file is not None else Document("options")
    given = {name: value for name, value in (flags or {}).items() if value is not None}
    document = document.merged(Document("command line", given))
    if settings:
        document = document.merged(load_overrides(list(settings)))
    try:
        options = PrepareOptions.model_validate(document.data)
    except ValidationError as error:
        raise SpecError("\n".join(explain(error, PrepareOptions, document, ()))) from error
    installed_priors(options, document, registry)  # what is wrong with them is said at once, too
    return options


def installed_priors(
    options: PrepareOptions, document: Document | None = None, registry: Registry | None = None
) -> dict[EvidenceKind, VideoPrior]:
    """The priors that `options.priors` names, built from their plugins.

    Args:
        document: where the options came from, for messages.

    Raises:
        SpecError: a prior is unknown, gives something else, or its settings are wrong.
    """
    registry = registry or default_registry()
    document = document or Document("options", options.model_dump(mode="json"))
    priors: dict[EvidenceKind, VideoPrior] = {}
    problems: list[str] = []
    for kind, spec in options.priors.items():
        place = ("priors", kind)
        at = f"{document.where((*place, 'use'))} priors.{kind}.use"
        try:
            component, config_class = registry.get(spec.use), registry.config_class(spec.use)
        except PluginError as error:
            problems.append(f"{at}: {error}")
            continue
        if not issubclass(component, VideoPrior) or kind not in component.provides:
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
        priors[kind] = component.from_config(config, BuildContext())
    if problems:
        raise SpecError("\n".join(problems))
    return priors


def refuse_commands(priors: Mapping[EvidenceKind, VideoPrior]) -> None:
    """SpecError, showing the command lines, if priors would run programs."""
    lines = [f"  priors.{kind}: {c}" for kind, prior in priors.items() for c in prior.commands()]
    if lines:
        found = "\n".join(lines)
        raise SpecError(
            f"these options run programs on this machine:\n{found}\n"
            "nothing was run; if you trust them, say --allow-commands (prepare(..., "
            "allow_commands=True))"
        )


def _givers(registry: Registry, kind: EvidenceKind) -> list[str]:
    """Keys of the installed priors that give a kind of evidence."""
    found = []
    for key in registry.keys("prior"):
        try:
            component = registry.get(key)
        except PluginError:  # one that lacks an extra cannot be chosen now
            continue
        if issubclass(component, VideoPrior) and kind in component.provides:
            found.append(key)
    return found
