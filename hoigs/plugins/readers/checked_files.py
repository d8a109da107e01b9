"""Files of data sets, checked: their listing, JSON content, numbers, and the readers' settings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import ClipError
from hoigs.core.system.files import read_json, regular_file, short


@dataclass(frozen=True)
class Need:
    """A file that a layout has, or a choice of files of which one is enough.

    Attributes:
        paths: relative to the folder, the usual one first; a name that ends in "/" is a folder.
        maker: where it comes from: a program, a download page, or what to do without it.
    """

    paths: tuple[str, ...]
    maker: str

    @staticmethod
    def of(*paths: str, maker: str) -> Need:
        """`Need.of("masks/0.png", "masks/0.jpg", maker=...)`: either is enough."""
        return Need(paths, maker)

    def found(self, folder: Path) -> Path | None:
        """The first of the choices that is there."""
        for path in self.paths:
            place = folder / path
            if place.is_dir() if path.endswith("/") else place.is_file():
                return place
        return None


def require_files(
    folder: Path, layout: str, needs: Iterable[Need], problems: Iterable[str] = ()
) -> None:
    """Refuse an incomplete folder.

    Args:
        folder: data folder. layout: its name, for the message: "HOSNeRF".
        needs: every file that the layout has.
        problems: other messages for the same error ("cameras.pkl has no frame 00003").

    Raises:
        ClipError: it names every absent file and its maker, and every problem.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ClipError(f"{folder} is not a folder; expected one in the layout of {layout}")
    absent = [need for need in needs if need.found(folder) is None]
    lines = [*_described(absent), *problems]
    if lines:
        text = "\n".join(f"  {line}" for line in lines)
        raise ClipError(f"{folder} cannot be read as {layout}:\n{text}")


def _described(absent: Iterable[Need]) -> Iterator[str]:
    """One line for each kind of file; files whose names differ in one number share a line."""
    groups: dict[tuple[str, tuple[str, ...]], list[Need]] = {}
    for need in absent:
        shape = tuple(re.sub(r"\d+", "#", path) for path in need.paths)
        groups.setdefault((need.maker, shape), []).append(need)
    for (maker, shape), needs in groups.items():
        choices = [_shared([need.paths[i] for need in needs]) for i in range(len(shape))]
        count = f" ({len(needs)} files)" if len(needs) > 1 else ""
        verb = "are" if count else "is"
        yield f"{' or '.join(choices)}{count} {verb} absent: {maker}"


def _shared(paths: list[str]) -> str:
    """The paths as one text: {0-3,7} where names differ in one number; otherwise all of them."""
    parts = [re.split(r"(\d+)", path) for path in paths]
    varying = [i for i in range(len(parts[0])) if len({p[i] for p in parts}) > 1]
    if not varying:
        return paths[0]
    if len(varying) > 1:
        return ", ".join(paths)
    place = varying[0]
    names = sorted({p[place] for p in parts}, key=int)
    runs: list[list[str]] = []
    for name in names:
        if runs and int(name) == int(runs[-1][-1]) + 1:
            runs[-1][1:] = [name]
        else:
            runs.append([name])
    parts[0][place] = "{" + ",".join("-".join(run) for run in runs) + "}"
    return "".join(parts[0])


# JSON files of data sets, checked against the layout's declared content.

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


# Numbers and lines of data sets' files, checked before anything is computed with them.


def numbers(value: Any, where: str, *shape: int, flat: bool = False) -> np.ndarray:
    """`value` as finite float64 numbers.

    Args:
        where: file and key, for the message. shape: expected shape; -1 leaves a size free, and
            without any, so is the whole shape. flat: as one row, whatever the shape in the file.

    Raises:
        ClipError: it holds something else, or has another shape.
    """
    try:
        found = np.asarray(value)
        if found.dtype.kind not in "biufO":  # texts and complex numbers could be converted
            raise TypeError(found.dtype)
        array = found.astype(np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ClipError(f"{where}: expected numbers, got {short(value)}") from error
    array = array.reshape(-1) if flat else array
    fits = len(shape) == array.ndim and all(
        wanted in (-1, found) for wanted, found in zip(shape, array.shape)
    )
    if shape and not fits:
        wanted = ", ".join("any" if size == -1 else str(size) for size in shape)
        raise ClipError(f"{where}: expected numbers of shape [{wanted}], got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise ClipError(f"{where}: some numbers are NaN or infinite")
    return array


def entry(table: Any, key: str, where: str) -> Any:
    """The value of a key of a dictionary.

    Raises:
        ClipError: there is none, or `table` is no dictionary.
    """
    if not isinstance(table, dict) or key not in table:
        found = ", ".join(map(str, list(table)[:8])) if isinstance(table, dict) else short(table)
        raise ClipError(f"{where} has no {key!r} (found {found})")
    return table[key]


def read_lines(path: Path) -> list[str]:
    """The lines of a text that are not empty, without space around them.

    Raises:
        ClipError: it is no text.
    """
    try:
        lines = regular_file(path).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ClipError(f"{path} is not text in UTF-8 ({error}); write it again") from error
    return [line.strip() for line in lines if line.strip()]


# Settings that readers share.


class ReaderConfig(ComponentConfig):
    """Settings of every reader of a folder of images."""

    cache_mb: int = Field(default=512, ge=0, description="decoded pixels kept in memory, MiB")


class VideoReaderConfig(ReaderConfig):
    """Settings of readers whose layout does not give the frames a second."""

    fps: float = Field(default=30.0, gt=0, description="frame rate; the layout has none")


class VideoPointsConfig(VideoReaderConfig):
    """Settings of readers whose layout has neither these nor scene points."""

    points: int = Field(default=20_000, ge=1, description="scene points to start from")
