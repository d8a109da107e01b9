"""pydantic's errors as messages about a spec: position, dotted key, what was expected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from hoigs.core.errors import did_you_mean
from hoigs.core.spec.loader import Document, Place

FORMER_KEYS = {"priors": "estimators"}  # of options files, before they were renamed


def explain(
    error: ValidationError, model: type[BaseModel], document: Document, place: Place
) -> list[str]:
    """One line for each error: `my.yaml:9:31 model.object.points: ...`.

    Args:
        error: raised by validating the value at `place` with `model`.
        document: where the value came from.
    """
    return [
        _line(problem, model, document, place)
        for problem in error.errors(include_url=False, include_context=False)
    ]


def _line(problem: Any, model: type[BaseModel], document: Document, place: Place) -> str:
    inside = _real_part(problem["loc"], _at(document.data, place), problem["type"])
    full = (*place, *inside)
    path = ".".join(str(part) for part in full) or "the whole file"
    if problem["type"] == "extra_forbidden":
        valid = list(_fields(model, inside[:-1]))
        key = str(inside[-1])
        present = FORMER_KEYS.get(key)
        near = f'; today it is "{present}"' if present in valid else did_you_mean(key, valid)
        hint = near or (f" (valid: {', '.join(valid)})" if valid else " (it has no settings)")
        return f"{document.where(full, key=True)} {path}: unknown key{hint}"
    if problem["type"] == "missing":
        return f"{document.where(full[:-1], key=True)} {path}: this key is missing"
    if problem["type"] in ("model_type", "model_attributes_type", "dict_type"):
        fields = _fields(model, inside)
        keys = f" with {', '.join(fields)}" if fields else ""
        message = f"expected a block of keys{keys}"
    else:
        message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    return f"{document.where(full)} {path}: {message}, got {_short(problem['input'])}"


def _at(data: Any, place: Place) -> Any:
    """The value at `place`; None where the default is used."""
    for part in place:
        data = data.get(part) if isinstance(data, dict) else None
    return data


def _real_part(loc: Place, value: Any, kind: str) -> Place:
    """`loc` without the names of union branches, which no file contains."""
    kept: list[str | int] = []
    for i, part in enumerate(loc):
        inside = isinstance(value, dict) and part in value
        inside = inside or (isinstance(value, list) and isinstance(part, int))
        absent = kind == "missing" and i == len(loc) - 1
        if inside or absent:
            kept.append(part)
            value = None if absent else value[part]
    return tuple(kept)


def _fields(model: type[BaseModel], inside: Place) -> list[str]:
    """Keys that are valid at a place inside `model`."""
    models = [model]
    for part in inside:
        fields = [m.model_fields[str(part)].annotation for m in models if part in m.model_fields]
        if fields:
            models = [m for annotation in fields for m in _models(annotation)]
        # otherwise `part` is a key of a dict or an index of a list of the models at hand
    return [name for m in models for name in m.model_fields]


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
