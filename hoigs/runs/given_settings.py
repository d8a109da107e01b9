"""Settings of one component as they are given on the command line: "key=value"."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document, load_value


def parse_settings(
    texts: Sequence[str], option: str, error: type[HoigsError] = HoigsError
) -> dict[str, Any]:
    """The values of "key=value" texts, each read as YAML.

    Args:
        option: that they were given by, for the message.

    Raises:
        HoigsError: or `error`: a text without a key or "=".
    """
    values = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise error(f"{option} {text}: expected key=value")
        values[key] = load_value(value, f"{option} {text}:")
    return values


def validated(
    kind: type[Any], values: dict[str, Any], key: str, error: type[HoigsError] = HoigsError
) -> ComponentConfig:
    """Settings of the component `key`.

    Raises:
        HoigsError: or `error`: a setting is unknown or of the wrong kind.
    """
    try:
        checked: ComponentConfig = kind.model_validate(values)
        return checked
    except ValidationError as problems:
        lines = explain(problems, kind, Document(f"{key}:", values), ())
        raise error("\n".join(lines)) from problems
