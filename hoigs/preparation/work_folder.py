"""The work folder: the results of a preparation's stages, kept so that the next run can resume.

A result is written under a temporary name and renamed when it is complete; it is stored with a key
of what it was made from, and read only for that key. A process killed at any moment leaves either a
complete result or none, and temporary names that the next run removes.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from hoigs.core.errors import ClipError
from hoigs.core.system.files import failures_named
from hoigs.core.system.folder_lock import FolderLock
from hoigs.core.system.npz import load_arrays

TEMPORARY = "."  # names that begin with it are not read, and are removed at the start
UNFINISHED = "unfinished-"
RESULT, ARRAYS = "result.json", "arrays.npz"


@dataclass(frozen=True)
class Result:
    """The result of a stage.

    Attributes:
        values: plain JSON. arrays: by name, of any dtype but object.
        files: writes further files into the folder that it is given; of a result that was read
            back they are in `folder`.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    files: Callable[[Path], object] | None = None
    folder: Path | None = None


class WorkFolder:
    """Results by stage in one folder, which one process at a time uses.

    >>> with WorkFolder("clips/mine.prepare") as work:
    ...     result = work.load("people", key) or work.save("people", key, make())

    Attributes:
        new: whether it is made for this run. worth_keeping: whether something in it took long.

    Raises:
        ClipError: another process uses it.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        self.worth_keeping = False

    def __enter__(self) -> WorkFolder:
        self.new = not self.root.exists()
        self._lock = FolderLock(self.root, "hoigs prepare", ClipError).acquire()
        self.root.mkdir(exist_ok=True)
        for path in self.root.iterdir():
            if path.name.startswith(TEMPORARY):
                _remove(path)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._lock.release()

    def load(self, stage: str, key: str | None = None) -> Result | None:
        """The stage's result, if there is a whole one for this key, or for any if `key` is None."""
        folder = self.root / stage
        try:
            content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
            if key is not None and content["key"] != key:
                return None
            return Result(content["values"], load_arrays(folder / ARRAYS), None, folder)
        except (FileNotFoundError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def save(self, stage: str, key: str, result: Result) -> Result:
        """Keeps a stage's result in place of an older one; returns it as `load` does."""
        fresh = self.temporary()
        try:
            with failures_named(self.root / stage):
                self._write(fresh, key, result)
        except BaseException:
            shutil.rmtree(fresh, ignore_errors=True)
            raise
        self.forget(stage)
        fresh.rename(self.root / stage)
        kept = self.load(stage, key)
        assert kept is not None
        return kept

    def _write(self, fresh: Path, key: str, result: Result) -> None:
        if result.files is not None:
            result.files(fresh)
        np.savez_compressed(fresh / ARRAYS, **result.arrays)  # type: ignore[arg-type]
        content = {"key": key, "values": result.values}
        text = json.dumps(content, indent=1, allow_nan=False)
        (fresh / RESULT).write_text(text, encoding="utf-8")
        for path in (fresh / ARRAYS, fresh / RESULT):
            _to_disk(path)

    def forget(self, stage: str) -> None:
        """Removes a stage's result, all at once."""
        folder = self.root / stage
        if folder.exists():
            gone = self.temporary() / "gone"
            folder.rename(gone)
            shutil.rmtree(gone.parent)

    def temporary(self) -> Path:
        """A new folder that is never read; the next run removes what is left of it."""
        return Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=self.root))

    def unfinished(self, stage: str, key: str) -> Path:
        """A folder for parts of a stage's result, kept for the next run with the same key.

        The caller makes the folder, and renames what is complete in it. Folders of other keys are
        removed.
        """
        kept = self.root / f"{UNFINISHED}{stage}-{key[:16]}"
        for path in self.root.glob(f"{UNFINISHED}{stage}-*"):
            if path != kept:
                _remove(path)
        return kept

    def discard(self) -> None:
        """Removes the whole folder."""
        shutil.rmtree(self.root)
        self._lock.release()


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _to_disk(path: Path) -> None:
    """Waits until a file's content is on the disk, as it must be before a rename."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def digest(content: Any) -> str:
    """SHA-256 of plain JSON, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def fingerprint(paths: Iterable[Path]) -> list[list[Any]]:
    """Name, size and time of change of files, and of all files in folders: cheap, and different
    after every edit.
    """
    found = []
    for path in paths:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in files:
            state = file.stat()
            name = str(file.relative_to(path)) if path.is_dir() else file.name
            found.append([name, state.st_size, state.st_mtime_ns])
    return found
