"""P10, P12 and P13: the component's settings, and building it from them."""

from __future__ import annotations

import importlib
import json

from pydantic import ValidationError

from hoigs.testing.checks import CheckError
from hoigs.testing.plugin.subject import CHECKS, PluginSubject, takes_settings
from hoigs.testing.runner import KINDS

NONSENSE = "no_setting_has_this_name"


@CHECKS.check("P10")
def it_is_built_from_its_settings(subject: PluginSubject) -> str | None:
    """It can be built from its default or given settings."""
    needed = [
        name
        for name, field in subject.config_class().model_fields.items()
        if field.is_required() and name not in subject.options.settings
    ]
    if needed:
        raise CheckError(
            f"{', '.join(needed)} has no default; set it for the check: "
            f'settings={{"{needed[0]}": …}}, or --set {needed[0]}=…'
        )
    config = subject.config()
    if subject.component.kind not in KINDS:
        return "its kind has no checks: it was not built"
    package = importlib.import_module(KINDS[subject.component.kind])
    package.subject(subject.registry.get(subject.offer.exact), config, subject.options)
    return None


@CHECKS.check("P12", takes_settings)
def unknown_settings_are_refused(subject: PluginSubject) -> None:
    """Unknown settings are refused."""
    try:
        subject.config_class().model_validate({**subject.options.settings, NONSENSE: 1})
    except ValidationError as error:
        if any(problem["loc"][-1:] == (NONSENSE,) for problem in error.errors()):
            return
    raise CheckError(
        f'{subject.component.config} accepts the setting "{NONSENSE}"; keep extra="forbid" of '
        "ComponentConfig, so that misspelt keys are errors"
    )


@CHECKS.check("P13", takes_settings)
def settings_survive_json(subject: PluginSubject) -> None:
    """Settings have a JSON schema, and are the same after a round trip through JSON."""
    config = subject.config()
    json.dumps(type(config).model_json_schema())
    again = type(config).model_validate(json.loads(config.model_dump_json()))
    if again != config:
        raise CheckError(f"after a round trip through JSON, {config!r} is {again!r}")
