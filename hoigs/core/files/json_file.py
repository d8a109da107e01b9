"""Reading JSON files back: one way in which a damaged one is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.files.regular_file import regular_file

MOST_BYTES = 64 * 2**20  # of a file that hoigs writes; one of this size is not ours
SHOWN, VALUE = 5, 60  # problems of one file, and characters of a wrong value, in a message

Record = TypeVar("Record", bound=BaseModel)


def parse_json(path: Path, most_bytes: int = MOST_BYTES) -> Any:
    """The content of a JSON file.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it cannot be read, is not JSON, too large, or nested too deeply.
    """
    try:
        if (size := regular_file(path).stat().st_size) > most_bytes:
            raise ValueError(f"{size} bytes, at most {most_bytes} are read")
        return json_value(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except UnicodeDecodeError as error:
        raise ValueError("not text in UTF-8") from error
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error


def json_value(text: str | bytes) -> Any:
    """The value that a text is.

    Raises:
        ValueError: it is not JSON, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: Path, *, error: type[HoigsError], advice: str) -> Any:
    """The content of a JSON file.

    Args:
        error, advice: class and end of the message.

    Raises:
        HoigsError: of class `error`: it is absent, or as `parse_json`.
    """
    try:
        return parse_json(path)
    except FileNotFoundError as problem:
        raise error(f"{path}: no such file; {advice}") from problem
    except ValueError as problem:
        raise error(f"{path}: damaged, not readable as JSON ({problem}); {advice}") from problem


def validated(
    content: Any, model: type[Record], place: object, *, error: type[HoigsError], advice: str
) -> Record:
    """JSON values checked against what they should hold; `place` begins the message.

    Raises:
        HoigsError: of class `error`, naming each key that is absent or wrong.
    """
    try:
        return model.model_validate(content)
    except ValidationError as problem:
        raise error(f"{place}: damaged: {problems_of(problem)}; {advice}") from problem


def problems_of(error: ValidationError) -> str:
    """Each key that is absent or wrong, in one line of bounded length."""
    found = error.errors()
    parts = []
    for one in found[:SHOWN]:
        where = ".".join(map(str, one["loc"]))[:VALUE] or "content"
        got = "" if one["type"] == "missing" else f" (got {short(one['input'])})"
        parts.append(f"{where}: {one['msg'][:200]}{got}")
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return "; ".join(parts) + more


def short(value: object) -> str:
    """A value for a message, of bounded length."""
    if isinstance(value, list | dict) and len(value) > 8:
        return f"a {type(value).__name__} of {len(value)} entries"
    try:
        text = repr(value)
    except RecursionError:
        return f"a deep {type(value).__name__}"
    except ValueError:  # Python writes no integer of more than 4300 digits
        return f"a {type(value).__name__} of very many digits"
    return text if len(text) <= VALUE else f"{text[:VALUE]}…"
