"""pydantic's errors as messages about a spec: position, dotted key, what was expected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from hoigs.core.errors import did_you_mean
from hoigs.core.spec.loader import Document, Place
from hoigs.core.system.files import short

FORMER_KEYS = {"priors": "estimators"}  # of options files, before they were renamed


def explain(
    error: ValidationError, model: type[BaseModel], document: Document, place: Place
) -> list[str]:
    """One line for each error: `my.yaml:9:31 model.object.points: ...`.

    Args:
        error: raised by validating the value at `place` with `model`.
        document: where the value came from.
    """
    found: dict[tuple[str, str], str] = {}
    for problem in error.errors(include_url=False, include_context=False):
        at, message, got = _parts(problem, model, document, place)
        known = found.get((at, got), message)  # of another branch of a union
        also = f", or {message.removeprefix('must be ')}" if known != message else ""
        found[at, got] = known + also
    return [f"{at}: {message}{got}" for (at, got), message in found.items()]


def _parts(
    problem: Any, model: type[BaseModel], document: Document, place: Place
) -> tuple[str, str, str]:
    """Where a problem is, what is wrong, and what came."""
    inside = _real_part(problem["loc"], _at(document.data, place), problem["type"])
    full = (*place, *inside)
    path = ".".join(str(part) for part in full)
    if problem["type"] == "extra_forbidden":
        valid = list(_fields(model, inside[:-1]))
        key = str(inside[-1])
        present = FORMER_KEYS.get(key)
        near = f'; today it is "{present}"' if present in valid else did_you_mean(key, valid)
        hint = near or (f" (valid: {', '.join(valid)})" if valid else " (it has no settings)")
        return _named(document.where(full, key=True), path), f"unknown key{hint}", ""
    if problem["type"] == "missing":
        at = document.where(full[:-1], key=True)
        if at.startswith("--set") and len(full) > 1:
            return _named(at, path), f"this key is missing{_new_block(document, full[:-1])}", ""
        return _named(at, path), "this key is missing", ""
    got, at = f", got {short(problem['input'])}", document.where(full)
    if problem["type"] in ("model_type", "model_attributes_type", "dict_type"):
        fields = _fields(model, inside)
        keys = f" with {', '.join(fields)}" if fields else ""
        message = f"expected a block of keys{keys}"
        if at.startswith("--set") and fields == ["use"] and isinstance(problem["input"], str):
            kind, name = str(full[-1]), problem["input"].rpartition(":")[2]
            brief = f"--rasterizer {name} or " if kind == "rasterizer" else ""
            got += f"; write {brief}--set {path}.use={kind}:{name}"
    else:
        message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
        message = message.partition(", unable to parse string")[0]
        if problem["type"] == "value_error" and isinstance(problem["input"], dict):
            got = ""  # of a block as a whole the message says enough
    return _named(at, path), message, got


def _named(at: str, path: str) -> str:
    """A position and a dotted key; an option of the command line ("--focal") is named alone."""
    option = at.startswith("--") and not at.endswith(":")
    return f"{at} {path}" if path and not option else at


def _new_block(document: Document, place: Place) -> str:
    """What to say of a block that only `--set` has made."""
    beside = _at(document.data, place[:-1])
    known = [
        name
        for name in beside
        if not document.where((*place[:-1], name), key=True).startswith("--set")
    ]
    near = did_you_mean(str(place[-1]), known)
    return f'; the spec has no "{place[-1]}" there{near} (has: {", ".join(known)})'


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
