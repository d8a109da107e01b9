"""Numbers and lines of data sets' files, checked before anything is computed with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.files.json_file import short
from hoigs.core.files.regular_file import regular_file


def numbers(value: Any, where: str, *shape: int, flat: bool = False) -> np.ndarray:
    """`value` as finite float64 numbers.

    Args:
        where: file and key, for the message. shape: of the result; -1 leaves a size free, and
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
