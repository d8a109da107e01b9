"""The files that a layout needs, and one error that lists every absent file and its source."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.errors import ClipError


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
        folder: of the data. layout: its name, for the message: "HOSNeRF".
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
