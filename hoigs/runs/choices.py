"""The options `device` and `rasterizer`, which everything that runs a model has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document, load_value


def pick_device(name: str) -> str:
    """`name` itself, or for "auto" "cuda" if available, else "cpu".

    Raises:
        HoigsError: `name` is a CUDA device, and this machine has none.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise HoigsError(f'device "{name}": this machine has no CUDA device; use "cpu"')
    return name


def with_rasterizer(overrides: Sequence[str] | None, rasterizer: str | None) -> list[str]:
    """Overrides of a spec ("a.b=value") and one for the rasterizer.

    Args:
        rasterizer: "warp" or "rasterizer:warp"; None keeps the spec's.
    """
    chosen = list(overrides or ())
    if rasterizer is not None:
        key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
        chosen.append(f"rasterizer.use={key}")
    return chosen


# Settings of one component as they are given on the command line: "key=value".


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
