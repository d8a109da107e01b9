"""C01 to C04: folders that are not its layout, and some that are it in part."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path

from hoigs.core.errors import ClipError
from hoigs.core.reader import ClipReader
from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require
from hoigs.testing.reader.subject import CHECKS, ReaderSubject, files_of, has_folder


def nonsense(room: Path) -> list[Path]:
    """Folders, and what is no folder, that are nobody's layout."""
    empty, full, file = room / "empty", room / "full", room / "file"
    for folder in (empty, full / "images", full / "clip"):
        folder.mkdir(parents=True)
    (full / "notes.txt").write_text("no clip")
    (full / "images" / "one.png").write_bytes(b"no picture")
    (full / "data.npz").write_bytes(b"no arrays")
    file.write_text("no folder")
    return [empty, full, file, room / "absent"]


@CHECKS.check("C01")
def nonsense_does_not_match(subject: ReaderSubject) -> None:
    """`matches` is False for empty and foreign folders, files and what is not there."""
    with tempfile.TemporaryDirectory() as room:
        for folder in nonsense(Path(room)):
            try:
                matches = subject.reader().matches(folder)
            except Exception as error:
                raise CheckError(f"matches({folder.name}) raises {error!r}") from error
            require(matches is False, f"matches({folder.name}) is {matches}, expected False")


@CHECKS.check("C02")
def matching_is_harmless(subject: ReaderSubject) -> None:
    """`matches` writes nothing."""
    with tempfile.TemporaryDirectory() as room:
        folders = nonsense(Path(room))
        before = {path: path.stat().st_mtime_ns for path in Path(room).rglob("*")}
        for folder in folders:
            with suppress(Exception):  # C01 judges that
                subject.reader().matches(folder)
        after = {path: path.stat().st_mtime_ns for path in Path(room).rglob("*")}
        require(before == after, f"matches changed {set(before.items()) ^ set(after.items())}")


@CHECKS.check("C03")
def nonsense_is_refused(subject: ReaderSubject) -> None:
    """Reading what is not its layout raises a ClipError that names the folder."""
    with tempfile.TemporaryDirectory() as room:
        for folder in nonsense(Path(room)):
            said = refusal(subject.reader(), folder)
            require(said is not None, f"read({folder.name}) makes a clip of nothing")
            require(folder.name in (said or ""), f"the error does not name the folder: {said}")


@CHECKS.check("C04", has_folder)
def a_partial_folder_is_one_error(subject: ReaderSubject) -> str:
    """Files that it needs, absent all at once, are named by one ClipError."""
    with subject.folder() as folder:
        reader = subject.reader()
        reader.read(folder)
        needed = [path for path in files_of(folder) if _is_needed(reader, folder, path)]
        # what is left must still be its layout, or there is nothing to be named
        absent = [path for path in needed if _still_matches(reader, folder, path)]
        for path in absent:
            path.rename(path.with_name(path.name + ".away"))
        said = refusal(subject.reader(), folder) if absent else ""
        require(said is not None, f"without {len(absent)} files that it needs, it reads a clip")
        unnamed = [str(p.relative_to(folder)) for p in absent if not _names(said or "", p, folder)]
        require(
            not unnamed,
            f"{len(absent)} files are absent, the error does not name {unnamed[:4]}: {said}",
        )
    return f"{len(absent)} files are needed, of {len(needed)} and more"


def _names(said: str, path: Path, folder: Path) -> bool:
    """A file by its name, or as one of those that are summed up by the folder they are in."""
    above = path.parent.name if path.parent != folder else path.name
    return path.name in said or path.stem in said or above in said


def _is_needed(reader: ClipReader, folder: Path, path: Path) -> bool:
    away = path.with_name(path.name + ".away")
    path.rename(away)
    try:
        return refusal(reader, folder) is not None
    finally:
        away.rename(path)


def _still_matches(reader: ClipReader, folder: Path, path: Path) -> bool:
    away = path.with_name(path.name + ".away")
    path.rename(away)
    try:
        return bool(reader.matches(folder))
    finally:
        away.rename(path)


def refusal(reader: ClipReader, folder: Path) -> str | None:
    """The message of the ClipError, or None when there is a clip; others are errors."""
    try:
        reader.read(folder)
    except ClipError as error:
        return str(error)
    except Exception as error:
        raise CheckError(f"read raises {error!r}, expected a ClipError") from error
    return None
