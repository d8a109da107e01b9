"""The work folder: what each stage of a preparation made, kept so that the next run goes on.

A result is written under a temporary name and renamed when it is whole; it carries the key of what
it was made from and is read only for that key. A process killed at any moment leaves either a
whole result or none, and temporary names that the next run removes.
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

from hoigs.core.clip_format import load_arrays
from hoigs.core.errors import ClipError

TEMPORARY = "."  # names that begin so are not read, and swept away at the start
UNFINISHED = "unfinished-"
RESULT, ARRAYS, LOCK = "result.json", "arrays.npz", "lock"


@dataclass(frozen=True)
class Result:
    """What a stage made.

    Attributes:
        values: plain JSON. arrays: by name, any but object dtype.
        files: writes further files into the folder that it is given; when a result is read back
            they lie in `folder`.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    files: Callable[[Path], None] | None = None
    folder: Path | None = None


class WorkFolder:
    """Results by stage in one folder, of which one process at a time is the owner.

    >>> with WorkFolder("clips/mine.prepare") as work:
    ...     result = work.load("body", key) or work.save("body", key, make())

    Raises:
        ClipError: another process is at work in it.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def __enter__(self) -> WorkFolder:
        from filelock import FileLock, Timeout

        self.new = not self.root.exists()
        self.root.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.root / LOCK)
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise ClipError(
                f"{self.root}: another `hoigs prepare` is at work there; wait for it or stop it"
            ) from error
        for path in self.root.iterdir():
            if path.name.startswith(TEMPORARY):
                _remove(path)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._lock.release()

    def load(self, stage: str, key: str) -> Result | None:
        """The stage's result, if there is one and it was made from what `key` stands for."""
        folder = self.root / stage
        try:
            content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        if content["key"] != key:
            return None
        return Result(content["values"], load_arrays(folder / ARRAYS), None, folder)

    def save(self, stage: str, key: str, result: Result) -> Result:
        """Keeps a stage's result in place of an older one; returns it as `load` would."""
        fresh = self.temporary()
        if result.files is not None:
            result.files(fresh)
        np.savez_compressed(fresh / ARRAYS, **result.arrays)  # type: ignore[arg-type]
        content = {"key": key, "values": result.values}
        text = json.dumps(content, indent=1, allow_nan=False)
        (fresh / RESULT).write_text(text, encoding="utf-8")
        for path in (fresh / ARRAYS, fresh / RESULT):
            _to_disk(path)
        self.forget(stage)
        fresh.rename(self.root / stage)
        kept = self.load(stage, key)
        assert kept is not None
        return kept

    def forget(self, stage: str) -> None:
        """Removes a stage's result, all at once."""
        folder = self.root / stage
        if folder.exists():
            gone = self.temporary() / "gone"
            folder.rename(gone)
            shutil.rmtree(gone.parent)

    def temporary(self) -> Path:
        """A new folder that nobody reads; the next run removes what is left of it."""
        return Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=self.root))

    def unfinished(self, stage: str, key: str) -> Path:
        """A folder for half of a stage's work, still there in the next run if `key` is the same.

        Whoever works in it names what is whole, and makes the folder; others' are removed.
        """
        kept = self.root / f"{UNFINISHED}{stage}-{key[:16]}"
        for path in self.root.glob(f"{UNFINISHED}{stage}-*"):
            if path != kept:
                _remove(path)
        return kept

    def discard(self) -> None:
        """Removes the whole folder; it may be entered again."""
        self._lock.release()
        shutil.rmtree(self.root)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _to_disk(path: Path) -> None:
    """Waits until a file's content is on the disk: a rename must not outrun it."""
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
