"""C01 to C04: folders in other layouts, and incomplete ones."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require
from hoigs.testing.reader.subject import CHECKS, ReaderSubject, files_of, has_folder


def foreign_folders(root: Path) -> list[Path]:
    """Paths in no layout: an empty folder, a folder with other files, a file, an absent path."""
    empty, full, file = root / "empty", root / "full", root / "file"
    for folder in (empty, full / "images", full / "clip"):
        folder.mkdir(parents=True)
    (full / "notes.txt").write_text("no clip")
    (full / "images" / "one.png").write_bytes(b"no picture")
    (full / "data.npz").write_bytes(b"no arrays")
    file.write_text("no folder")
    return [empty, full, file, root / "absent"]


@CHECKS.check("C01")
def foreign_folders_do_not_match(subject: ReaderSubject) -> None:
    """`matches` is False for empty and foreign folders, files and absent paths."""
    with tempfile.TemporaryDirectory() as root:
        for folder in foreign_folders(Path(root)):
            try:
                matches = subject.reader().matches(folder)
            except Exception as error:
                raise CheckError(f"matches({folder.name}) raises {error!r}") from error
            require(matches is False, f"matches({folder.name}) is {matches}, expected False")


@CHECKS.check("C02")
def matches_writes_nothing(subject: ReaderSubject) -> None:
    """`matches` writes nothing."""
    with tempfile.TemporaryDirectory() as root:
        folders = foreign_folders(Path(root))
        before = {path: path.stat().st_mtime_ns for path in Path(root).rglob("*")}
        for folder in folders:
            with suppress(Exception):  # C01 checks that
                subject.reader().matches(folder)
        after = {path: path.stat().st_mtime_ns for path in Path(root).rglob("*")}
        require(before == after, f"matches changed {set(before.items()) ^ set(after.items())}")


@CHECKS.check("C03")
def foreign_folders_are_refused(subject: ReaderSubject) -> None:
    """Reading a folder in another layout raises a ClipError that names it."""
    with tempfile.TemporaryDirectory() as root:
        for folder in foreign_folders(Path(root)):
            message = refusal(subject.reader(), folder)
            require(
                message is not None, f"read({folder.name}) returns a clip, expected a ClipError"
            )
            require(
                folder.name in (message or ""), f"the error does not name the folder: {message}"
            )


@CHECKS.check("C04", has_folder)
def one_error_names_all_absent_files(subject: ReaderSubject) -> str:
    """One ClipError names all required files that are absent."""
    with subject.folder() as folder:
        reader = subject.reader()
        reader.read(folder)
        needed = [path for path in files_of(folder) if _is_needed(reader, folder, path)]
        # without these files the folder must still match, or there is no error to check
        absent = [path for path in needed if _still_matches(reader, folder, path)]
        for path in absent:
            path.rename(path.with_name(path.name + ".away"))
        message = refusal(subject.reader(), folder) if absent else ""
        require(
            message is not None, f"without {len(absent)} required files, it still returns a clip"
        )
        unnamed = [
            str(p.relative_to(folder)) for p in absent if not _names(message or "", p, folder)
        ]
        require(
            not unnamed,
            f"{len(absent)} files are absent, the error does not name {unnamed[:4]}: {message}",
        )
    return f"{len(absent)} of {len(needed)} required files can be absent while the layout matches"


def _names(message: str, path: Path, folder: Path) -> bool:
    """Whether a message names a file, or the folder that it is in."""
    above = path.parent.name if path.parent != folder else path.name
    return path.name in message or path.stem in message or above in message


@contextmanager
def _without(path: Path) -> Iterator[None]:
    """The file is renamed, and so absent, in this block."""
    away = path.with_name(path.name + ".away")
    path.rename(away)
    try:
        yield
    finally:
        away.rename(path)


def _is_needed(reader: ClipReader, folder: Path, path: Path) -> bool:
    with _without(path):
        return refusal(reader, folder) is not None


def _still_matches(reader: ClipReader, folder: Path, path: Path) -> bool:
    with _without(path):
        return bool(reader.matches(folder))


def refusal(reader: ClipReader, folder: Path) -> str | None:
    """The message of the ClipError, or None when a clip is returned."""
    try:
        reader.read(folder)
    except ClipError as error:
        return str(error)
    except Exception as error:
        raise CheckError(f"read raises {error!r}, expected a ClipError") from error
    return None
