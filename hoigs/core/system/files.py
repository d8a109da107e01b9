"""Files that appear whole or not at all, JSON files read back, and names that may name files."""

from __future__ import annotations

import difflib
import errno
import json
import re
import stat
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from hoigs.core.errors import HoigsError


def named(path: Path) -> Path:
    """`path` with a name of its own, so that others can be made of it: that of the folder itself
    in place of "." and ".."."""
    return path.resolve() if path.name in ("", "..") else path


@contextmanager
def failures_named(path: Path) -> Iterator[None]:
    """Errors of the system in the block that name no file name this one: a full disk is noticed by
    write(), which knows no name."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def written_whole(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """A temporary name to write to, renamed to `path` after the block and removed if it fails.

    Args:
        temporary: by default ".NAME.part" beside it.
    """
    temporary = temporary or path.with_name(f".{path.name}.part")
    try:
        with failures_named(path):
            yield temporary
            temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: str | bytes, temporary: Path | None = None) -> None:
    """Write a file through a temporary name; text as UTF-8."""
    with written_whole(path, temporary) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


# Whether a path is a file of bytes: reading a FIFO waits for a writer, perhaps for ever.

AnyPath = TypeVar("AnyPath", str, Path)
OTHER = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class NotRegularError(OSError):
    """A FIFO, a socket or a device; `strerror` says which, `filename` is the path."""

    def __str__(self) -> str:
        return str(self.strerror)  # messages have the path before it


def regular_file(path: AnyPath) -> AnyPath:
    """`path`, unless it is a FIFO, a socket or a device, which could block a reader forever.

    Raises:
        FileNotFoundError: there is nothing.
        NotRegularError: a FIFO, a socket or a device.
    """
    mode = Path(path).stat().st_mode
    if kind := OTHER.get(stat.S_IFMT(mode)):
        raise NotRegularError(errno.EINVAL, f"is {kind}, expected a regular file", str(path))
    return path


# Reading JSON files back: one way in which a damaged one is named.

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


# Names that are used as names of files and folders: of entities and of specs.

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
RULE = "use letters, digits, _, - and . , a letter or digit first"
ENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def require_entity_name(name: str) -> None:
    """Raise ValueError for a name that no entity can have.

    Names of entities are also keys of specs and of torch's modules: in both a dot separates the
    parts of a path, and a module's own attributes ("type", "train") are taken.
    """
    from torch import nn

    if not ENTITY.fullmatch(name):
        raise ValueError(
            f"entity name {name!r}: names of entities have letters, digits, _ and -, a letter or "
            "digit first, and no dots"
        )
    if hasattr(nn.ModuleDict, name):
        raise ValueError(
            f"entity name {name!r}: torch's modules have an attribute of that name; take another, "
            f"as {name}_1"
        )


def name_from(text: str, otherwise: str) -> str:
    """`text` with "-" for each run of characters that no name has; `otherwise` if none is left."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("_.-") or otherwise


def is_plain(text: str) -> bool:
    """Whether a text has neither control characters nor halves of characters, which files,
    terminals and command lines do not hold."""
    return not any(unicodedata.category(c) in ("Cc", "Cs") for c in text)


def printable(text: str) -> str:
    """`text` for a terminal, without control characters but line breaks: names from files may hold
    escape sequences."""
    shown = (c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)
    return "".join(shown)


def did_you_mean_beside(path: Path, holds: str = "") -> str:
    """`; did you mean "runs/mine"?` of a path that does not exist, with what lies beside it under
    the nearest name, or ";".

    Args:
        holds: a file in it; only folders with such a file are proposed.
    """
    with suppress(OSError):
        names = [p.name for p in path.parent.iterdir() if not holds or (p / holds).is_file()]
        near = difflib.get_close_matches(path.name, names, n=1, cutoff=0.6)
        return f'; did you mean "{path.with_name(near[0])}"?' if near else ";"
    return ";"
