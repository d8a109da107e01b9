"""BatchFolder: the folder of a batch on disk, with its rows and the folders of these."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.files.folder_lock import FolderLock
from hoigs.core.files.json_file import json_value
from hoigs.core.files.regular_file import regular_file
from hoigs.core.files.whole_files import written_whole
from hoigs.studies.batch.manifest import Row

BATCH = "batch.jsonl"
MANY = 10_000  # rows, from which on they lie in 256 folders: network disks list large ones slowly
HALVES = [f"{i:02x}" for i in range(256)]
TURN_POLL_S = 0.2


class TakenError(HoigsError):
    """Another driver has this row or file."""


@dataclass(frozen=True)
class BatchFolder:
    """The folder that `hoigs batch` was given as --out.

    Attributes:
        fan_out: whether a row's folder is rows/xx/NAME, with a hash of its name, or rows/NAME. It
            is decided when the batch is begun, and stays.
    """

    path: Path
    fan_out: bool = False

    def of(self, row: Row) -> Path:
        return self.path / self.relative(row)

    def relative(self, row: Row) -> str:
        """The folder of a row, from the batch's."""
        if not self.fan_out:
            return f"rows/{row.name}"
        return f"rows/{hashlib.sha256(row.name.encode()).hexdigest()[:2]}/{row.name}"

    def rows(self) -> Iterator[Row]:
        """All rows of the batch, read one by one.

        Raises:
            HoigsError: the list is damaged.
        """
        with regular_file(self.path / BATCH).open(encoding="utf-8") as file:
            next(file)
            for number, line in enumerate(file, 2):
                try:
                    yield Row.model_validate_json(line)
                except ValueError as error:
                    raise _damaged(self.path / BATCH, number) from error

    @classmethod
    def begin(cls, path: Path, rows: Iterable[Row], many: int = MANY) -> BatchFolder:
        """Make the folder, or bring the rows of an existing one up to date.

        Args:
            rows: checked as they come; if one cannot be used, the folder stays as it was.
            many: rows from which on a new batch has `fan_out`.

        Raises:
            HoigsError: `path` is a file; or as `rows` raises.
        """
        if path.exists() and not path.is_dir():
            raise HoigsError(f"{path}: is a file; --out names a folder")
        first = next(rows := iter(rows), None)  # a wrong one raises before a folder is made
        path.mkdir(parents=True, exist_ok=True)
        with in_turn(path / BATCH), written_whole(path / BATCH) as part:
            known, count = cls._known(path), 0
            with part.open("w", encoding="utf-8") as file:
                file.write(_head(False))
                for row in chain([first] if first else [], rows):
                    file.write(f"{row.model_dump_json()}\n")
                    count += 1
                fan_out = count >= many if known is None else known
                file.seek(0)
                file.write(_head(fan_out))
        made = cls(path, fan_out)
        for half in HALVES if fan_out else [""]:
            (path / "rows" / half).mkdir(parents=True, exist_ok=True)
        return made

    @classmethod
    def _known(cls, path: Path) -> bool | None:
        """The `fan_out` of a batch that is there, by its folders where its list is damaged; None:
        there is no batch."""
        if not (path / BATCH).exists():
            return None
        try:
            return cls.open(path).fan_out
        except HoigsError:
            return all((path / "rows" / half).is_dir() for half in HALVES)

    @classmethod
    def open(cls, path: Path) -> BatchFolder:
        """A batch that was begun.

        Raises:
            HoigsError: there is none, or its list of rows is damaged.
        """
        try:
            with regular_file(path / BATCH).open(encoding="utf-8") as file:
                return cls(path, bool(json_value(file.readline())["fan_out"]))
        except FileNotFoundError:
            raise HoigsError(
                f"{path}: no batch; `hoigs batch MANIFEST --out {path}` begins one"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise _damaged(path / BATCH, 1) from error


@contextmanager
def in_turn(path: Path) -> Iterator[None]:
    """Wait until no other driver writes this file, and keep them from it."""
    lock = FolderLock(path, "hoigs batch", TakenError)
    while True:
        try:
            lock.acquire()
            break
        except TakenError:
            time.sleep(TURN_POLL_S)
    try:
        yield
    finally:
        lock.release()


def _head(fan_out: bool) -> str:
    """The first line, always as long."""
    return json.dumps({"fan_out": fan_out}).ljust(20) + "\n"


def _damaged(path: Path, line: int) -> HoigsError:
    return HoigsError(f"{path}:{line}: damaged; `hoigs batch` writes it again")
