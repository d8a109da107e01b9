"""What `--overwrite` may replace: a folder that hoigs made, with nothing else in it."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.errors import HoigsError

SHOWN = 5  # foreign files that an error names


@dataclass(frozen=True)
class Layout:
    """What hoigs writes into one kind of folder.

    Attributes:
        what: in words, "run". maker: the command that makes one.
        required: paths that a complete one has.
        files, folders: patterns of all paths inside that hoigs writes, relative, with "/".
    """

    what: str
    maker: str
    required: tuple[str, ...]
    files: re.Pattern[str]
    folders: re.Pattern[str]

    def missing(self, folder: Path) -> list[str]:
        return [name for name in self.required if not (folder / name).exists()]

    def foreign(self, folder: Path, place: str = "") -> Iterator[str]:
        """Paths inside that hoigs does not write; of a foreign folder, its own path alone.

        Args:
            place: what paths begin with.
        """
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            path = place + entry.name
            if not entry.is_dir(follow_symlinks=False):
                if not self.files.fullmatch(path):
                    yield path
            elif self.folders.fullmatch(path):
                yield from self.foreign(folder / entry.name, f"{path}/")
            else:
                yield f"{path}/"


def one_of(*patterns: str) -> re.Pattern[str]:
    """Any of these regular expressions."""
    return re.compile("|".join(f"(?:{pattern})" for pattern in patterns))


def refuse_place(
    folder: Path, *, inputs: Iterable[Path] = (), error: type[HoigsError] = HoigsError
) -> None:
    """Raise where a folder can never be replaced, whatever is in it.

    Args:
        inputs: what is read to make the new one; it is not to disappear with the old one.

    Raises:
        HoigsError: or `error`: a symbolic link, the working directory, a folder that holds it or
            one of the inputs.
    """
    advice = "name another folder to write"
    if folder.is_symlink():
        raise error(f"{folder} is a symbolic link, which is not replaced; {advice}")
    if not folder.exists():
        return
    if not folder.is_dir():
        raise error(f"{folder} is a file; {advice}")
    real = folder.resolve()
    if Path.cwd().resolve().is_relative_to(real):
        raise error(f"{folder} is the working directory or holds it; {advice}")
    for path in inputs:
        if path.resolve().is_relative_to(real):
            raise error(f"{folder} is or holds the input {path}; {advice}")


def refuse_within(folder: Path, source: Path) -> None:
    """Raise HoigsError where `folder`, made from `source`, would be written inside of it."""
    if folder.resolve().is_relative_to(source.resolve()):
        raise HoigsError(
            f"{folder} lies inside of {source}, which it is made from and which would change by "
            "it; name a folder outside: --out"
        )


def refuse_unwritable(folder: Path, *, error: type[HoigsError] = HoigsError) -> None:
    """Raise where no folder of this name can be made: found out before work, not after it.

    A temporary folder is made in the nearest parent that exists, and removed.

    Raises:
        HoigsError: or `error`: a parent is a file or a broken link, the disk can only be read or is
            full, or the name is too long.
    """
    parent, names = folder.absolute().parent, [f".{folder.absolute().name}.old.1234567.part"]
    while not os.path.lexists(parent):
        parent, names = parent.parent, [*names, parent.name]
    if not parent.is_dir():
        raise error(f"{folder}: {parent} is no folder; name another folder to write")
    try:
        with tempfile.TemporaryDirectory(prefix=".hoigs-", suffix=".part", dir=parent) as made:
            for name in names:
                with contextlib.suppress(FileNotFoundError):
                    (Path(made) / name).lstat()  # for the error of a name that is too long
    except OSError as problem:
        raise error(
            f"{folder} cannot be made in {parent}: {problem.strerror}; name another folder to write"
        ) from problem


def require_replaceable(
    folder: Path,
    layout: Layout,
    *,
    inputs: Iterable[Path] = (),
    error: type[HoigsError] = HoigsError,
) -> None:
    """Raise unless `folder` is absent, empty, or complete and hoigs's own in every entry.

    Raises:
        HoigsError: or `error`: as `refuse_place`, or what is missing, or the first foreign files.
    """
    refuse_place(folder, inputs=inputs, error=error)
    if not folder.exists() or not any(folder.iterdir()):
        return
    missing = layout.missing(folder)
    if missing:
        raise error(
            f"{folder} is not replaced: it is not empty and not a complete {layout.what} "
            f"({', '.join(missing)} absent); name another folder, or remove this one yourself"
        )
    foreign = list(layout.foreign(folder))
    if foreign:
        more = f" and {len(foreign) - SHOWN} more" if len(foreign) > SHOWN else ""
        raise error(
            f"{folder} is not replaced: {', '.join(foreign[:SHOWN])}{more} in it did not come from "
            f"{layout.maker}; move them away, or name another folder"
        )


def put_in_place(new: Path, folder: Path) -> None:
    """Rename `new` to `folder`; what was there is removed only after that."""
    old = folder.with_name(f".{folder.name}.old.{os.getpid()}.part")
    if not folder.exists():
        new.rename(folder)
        return
    folder.rename(old)
    try:
        new.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    # a file that is still open elsewhere may stay; `RunFolder.create` removes the rest some day
    shutil.rmtree(old, ignore_errors=True)
