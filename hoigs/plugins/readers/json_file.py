"""JSON files of data sets, checked against what a layout says is in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from hoigs.core.errors import ClipError

Model = TypeVar("Model", bound=BaseModel)
SHOWN = 6  # problems of one file


def load_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        ClipError: it cannot be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ClipError(f"{path} is not readable as JSON ({error}); write it again") from error


def parse_json(path: Path, model: type[Model]) -> Model:
    """A JSON file as `model` says; keys that the model lacks are left alone.

    Raises:
        ClipError: naming each key that is absent or of another kind.
    """
    try:
        return model.model_validate(load_json(path))
    except ValidationError as error:
        raise ClipError(_told(path, error)) from error


def parse_json_map(path: Path, model: type[Model]) -> dict[str, Model]:
    """A JSON object whose values are all of one kind, by their keys.

    Raises:
        ClipError: as `parse_json`.
    """
    try:
        return TypeAdapter(dict[str, model]).validate_python(load_json(path))
    except ValidationError as error:
        raise ClipError(_told(path, error)) from error


def _told(path: Path, error: ValidationError) -> str:
    problems = error.errors()
    lines = [
        f"  {'.'.join(map(str, problem['loc'])) or 'content'}: {problem['msg']}"
        for problem in problems[:SHOWN]
    ]
    if len(problems) > SHOWN:
        lines.append(f"  … and {len(problems) - SHOWN} more")
    return "\n".join((f"{path} is not as its layout has it:", *lines))
