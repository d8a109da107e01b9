"""JSON files of data sets, checked against the layout's declared content."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from hoigs.core.errors import ClipError
from hoigs.core.files.json_file import read_json

Model = TypeVar("Model", bound=BaseModel)
SHOWN = 6  # problems listed for one file


def load_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        ClipError: it cannot be read.
    """
    return read_json(path, error=ClipError, advice="write it again")


def parse_json(path: Path, model: type[Model]) -> Model:
    """A JSON file validated by `model`; keys that the model lacks are ignored.

    Raises:
        ClipError: naming each key that is absent or of another kind.
    """
    try:
        return model.model_validate(load_json(path))
    except ValidationError as error:
        raise ClipError(_message(path, error)) from error


def parse_json_map(path: Path, model: type[Model]) -> dict[str, Model]:
    """A JSON object whose values are all of one kind, by their keys.

    Raises:
        ClipError: as `parse_json`.
    """
    try:
        return TypeAdapter(dict[str, model]).validate_python(load_json(path))
    except ValidationError as error:
        raise ClipError(_message(path, error)) from error


def _message(path: Path, error: ValidationError) -> str:
    problems = error.errors()
    lines = [
        f"  {'.'.join(map(str, problem['loc'])) or 'content'}: {problem['msg']}"
        for problem in problems[:SHOWN]
    ]
    if len(problems) > SHOWN:
        lines.append(f"  … and {len(problems) - SHOWN} more")
    return "\n".join((f"{path} does not have the content of its layout:", *lines))
