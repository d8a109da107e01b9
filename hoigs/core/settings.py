"""Settings of a config class as a table: name, type, default and meaning, for people to read."""

from __future__ import annotations

import re
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
    """Every setting of a config class; blocks within it are taken apart."""
    meanings, rows = field_docs(config), []
    for name, field in config.model_fields.items():
        block = field.annotation
        if isinstance(block, type) and issubclass(block, BaseModel) and not field.is_required():
            rows += describe_settings(block, f"{prefix}{name}.")
            continue
        default = None
        if not field.is_required():
            default = repr(field.get_default(call_default_factory=True))
        kind, bar, none = _spelled(field.annotation).partition(" | None")
        kind += _bounds(field.metadata) + bar + none
        rows.append(Setting(prefix + name, kind, default, meanings[name]))
    return rows


def _spelled(annotation: Any) -> str:
    """A type in the words of a spec."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation in (None, type(None)):
        return "None"
    if origin is Literal:
        return " | ".join(map(repr, arguments))
    if origin in (Union, types.UnionType):
        return " | ".join(map(_spelled, arguments))
    if origin is Annotated:
        marks = [
            m for a in arguments[1:] for m in (a.metadata if isinstance(a, FieldInfo) else [a])
        ]
        return _spelled(arguments[0]) + _bounds(marks)
    if origin is not None:
        inner = ", ".join("..." if a is Ellipsis else _spelled(a) for a in arguments)
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


def field_docs(config: type[BaseModel]) -> dict[str, str]:
    """What each field means: its description, else the words that the docstring has for it.

    A docstring says "name: words" or "one, two: words" under "Attributes:"; those of base classes
    count too.
    """
    names = sorted(map(re.escape, config.model_fields), key=len, reverse=True)
    found: dict[str, str] = {}
    if names:
        one = f"(?:{'|'.join(names)})"
        heads = re.compile(rf"(?:^|(?<=\s))({one}(?:, {one})*):\s")
        for base in reversed(config.__mro__):
            text = " ".join((vars(base).get("__doc__") or "").partition("Attributes:")[2].split())
            parts = heads.split(text)
            for head, words in zip(parts[1::2], parts[2::2]):
                found |= dict.fromkeys(head.split(", "), words.strip())
    given = {name: field.description for name, field in config.model_fields.items()}
    return {name: given[name] or found.get(name, "") for name in config.model_fields}
