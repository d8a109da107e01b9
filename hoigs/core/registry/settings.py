"""Settings of a config class as a table: name, type, default and meaning, for people to read."""

from __future__ import annotations

import types
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

_BOUNDS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        name: dotted where it belongs to a block of settings. type: as a spec's author needs it.
        default: as Python writes it; None where a value is required. meaning: may be empty.
    """

    name: str
    type: str
    default: str | None
    meaning: str


def describe_settings(config: type[BaseModel], prefix: str = "") -> list[Setting]:
    """Every setting of a config class; nested blocks are listed by dotted names."""
    rows: list[Setting] = []
    for name, field in config.model_fields.items():
        block = field.annotation
        if isinstance(block, type) and issubclass(block, BaseModel) and not field.is_required():
            rows += describe_settings(block, f"{prefix}{name}.")
            continue
        default = None
        if not field.is_required():
            default = repr(field.get_default(call_default_factory=True))
        kind, bar, none = spelled(field.annotation).partition(" | None")
        kind += _bounds(field.metadata) + bar + none
        rows.append(Setting(prefix + name, kind, default, field.description or ""))
    return rows


def spelled(annotation: Any) -> str:
    """A type as a spec's author needs it."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation in (None, type(None)):
        return "None"
    if origin is Literal:
        return " | ".join(map(repr, arguments))
    if origin in (Union, types.UnionType):
        return " | ".join(map(spelled, arguments))
    if origin is Annotated:
        marks = [
            m for a in arguments[1:] for m in (a.metadata if isinstance(a, FieldInfo) else [a])
        ]
        return spelled(arguments[0]) + _bounds(marks)
    if origin is not None:
        inner = ", ".join("..." if a is Ellipsis else spelled(a) for a in arguments)
        return f"{origin.__name__}[{inner}]"
    if annotation is Path:
        return "path"
    return getattr(annotation, "__name__", str(annotation))


def _bounds(marks: list[Any]) -> str:
    parts = [
        f" {sign} {getattr(mark, name)}"
        for mark in marks
        for name, sign in _BOUNDS.items()
        if getattr(mark, name, None) is not None
    ]
    return " and".join(parts)
