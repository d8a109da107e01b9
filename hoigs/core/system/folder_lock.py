"""FolderLock: one holder at a time writes a folder, on local and on network disks.

The lock is a file beside the folder, since the folder itself may be replaced. It is created
exclusively and removed by rename, which NFS does atomically where flock may do nothing. It names
its process, and a thread renews its time: a lock whose process is dead on this machine, or that was
not renewed for two minutes on another one, is taken over. Its token is new each time, so a holder
that was suspended, and processes that work for it, see that it is another's by now (`is_held`).

A disk offers no write that depends on a lock. Holders therefore look (`require_held`) right before
they rename what they wrote into place; a suspension between these two steps is not covered.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import tempfile
import threading
import time
import uuid
import weakref
from pathlib import Path
from types import TracebackType
from typing import Any

from hoigs.core.errors import HoigsError

HEARTBEAT_S = 15.0
STALE_S = 120.0
WRITTEN_S = 0.2  # a record is written within this time after its file is made
SUFFIX = ".lock"
_HELD: set[str] = set()  # tokens of this process


class FolderLock:
    """The right to write `folder`, from `acquire` to `release`, or as a context.

    It excludes other threads of the same process too.

    Args:
        folder: it need not exist; missing parents are made, and removed again if they stay empty.
        work: of the holder, for the message of others: "training". error: class of these messages.
        token: of a lock of this folder that the caller holds already. This one is then a part of
            it: it is held while that one is, and its release leaves that one as it is.
    """

    def __init__(
        self, folder: Path, work: str, error: type[HoigsError] = HoigsError, token: str = ""
    ) -> None:
        self.folder = folder.absolute()
        self.path = self.folder.with_name(f".{self.folder.name}{SUFFIX}")
        self.work, self.error = work, error
        self._token, self._outer = "", token
        self._ended = threading.Event()
        self._made: list[Path] = []

    @property
    def token(self) -> str:
        """Of the present hold; "" while it is not held."""
        return self._token

    @property
    def lease(self) -> str:
        """The present hold as text, for processes that work for the holder: PATH:TOKEN."""
        return f"{self.path}:{self._token}" if self._token else ""

    def acquire(self) -> FolderLock:
        """Take the lock.

        Raises:
            HoigsError: another process or thread holds it.
        """
        if self._outer:
            self._token = self._outer
            self.require_held()
            return self
        self._make_parents()
        token = uuid.uuid4().hex
        record = {"work": self.work, "token": token, **_this_process()}
        _HELD.add(token)  # before its file is there for another thread to see
        try:
            self._create(json.dumps(record))
        except BaseException:
            _HELD.discard(token)
            _remove_empty(self._made)
            raise
        self._token, self._ended = token, threading.Event()
        _Heartbeat(self.path, token, self._ended).start()
        weakref.finalize(self, _release, self.path, token, self._ended, list(self._made))
        return self

    def _create(self, record: str) -> None:
        for _ in range(3):  # a stale lock may be taken over by another process first
            if _create(self.path, record):
                return
            self._take_over_stale()
        raise self.error(f"{self.folder}: other processes are about to write it; try again")

    def release(self) -> None:
        """Give the lock back; nothing happens where this process does not hold it any more."""
        if self._token and not self._outer:
            _release(self.path, self._token, self._ended, self._made)
        self._token = ""

    def holder(self) -> str:
        """Who holds it and is alive, as text; "" if it is free."""
        record, age = _read_whole(self.path), _age(self.path)
        if age is None or _is_stale(record, age):
            return ""
        here = record.get("token") in _HELD
        who = "this process itself" if here else "another process"
        return (
            f"{who} ({record.get('work', '?')}, pid {record.get('pid', '?')} on "
            f"{record.get('host', '?')}, alive {age:.0f} s ago)"
        )

    def is_lost(self) -> bool:
        """Whether the lock was this holder's and is another's or gone, by a disk that answers."""
        return bool(self._token) and not is_held(self.path, self._token)

    def require_held(self) -> None:
        """Raise `error` if another process took the lock over, as after a long suspension."""
        if self._token and _read(self.path).get("token") != self._token:
            raise self.error(
                f"{self.folder}: another process took this folder over, since this one was "
                "suspended or its disk did not answer; nothing more is written"
            )

    def __enter__(self) -> FolderLock:
        return self.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.release()

    def _make_parents(self) -> None:
        missing, parent = [], self.path.parent
        while not parent.exists():
            missing.append(parent)
            parent = parent.parent
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._made = missing  # the innermost first

    def _take_over_stale(self) -> None:
        """Move a stale lock away.

        Raises:
            HoigsError: it is not stale.
        """
        token = _read_whole(self.path).get("token")  # first: a later one is another holder's
        if who := self.holder():
            raise self.error(
                f"{self.folder} is being written by {who}: wait for it, stop it, or name another "
                f"folder; if it cannot be there any more, remove {self.path}"
            )
        moved = self.path.with_name(f"{self.path.name}.{uuid.uuid4().hex[:8]}.part")
        try:
            self.path.rename(moved)
        except FileNotFoundError:
            return
        if _read(moved).get("token") != token:  # another one was quicker
            with contextlib.suppress(OSError):
                os.link(moved, self.path)  # unlike rename, never over a third one
        moved.unlink(missing_ok=True)


class _Heartbeat(threading.Thread):
    """Renews the time of a lock until it has ended or belongs to another."""

    def __init__(self, path: Path, token: str, ended: threading.Event) -> None:
        super().__init__(name="hoigs-lock", daemon=True)
        self._path, self._token, self._ended_event = path, token, ended

    def run(self) -> None:
        while not self._ended_event.wait(HEARTBEAT_S):
            with contextlib.suppress(OSError):  # a disk that does not answer now may do so later
                if _read(self._path).get("token") != self._token:
                    return
                os.utime(self._path)


def is_held(path: Path, token: str) -> bool:
    """Whether the lock file `path` has this token, and its holder is not known to be dead (one on
    another machine may be alive); also where it cannot be read now."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return False
    except (OSError, ValueError, RecursionError):
        return True
    return isinstance(found, dict) and found.get("token") == token and not _is_stale(found, 0.0)


def _create(path: Path, text: str) -> bool:
    """Make a file with `text` unless there is one."""
    try:
        file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
    except FileExistsError:
        return False
    try:
        with os.fdopen(file, "w", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:  # the disk is full, say: an empty lock would keep all others away
        path.unlink(missing_ok=True)
        error.filename = error.filename or str(path)
        raise
    return True


def _release(path: Path, token: str, ended: threading.Event, made: list[Path]) -> None:
    ended.set()
    _HELD.discard(token)
    with contextlib.suppress(OSError):
        if _read(path).get("token") == token:
            path.unlink()
        _remove_empty(made)


def _remove_empty(folders: list[Path]) -> None:
    """Up to the first in which something was written."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


def _read(path: Path) -> dict[str, Any]:
    """The record of a lock; {} where it is absent, or is being written just now."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _read_whole(path: Path) -> dict[str, Any]:
    """The record of a lock, also where its file was made just now and is still empty."""
    until = time.monotonic() + WRITTEN_S
    while not (found := _read(path)) and path.exists() and time.monotonic() < until:
        time.sleep(0.005)
    return found


def _age(path: Path) -> float | None:
    """Seconds since a lock was renewed, by the clock of its disk; None if it is gone."""
    try:
        renewed = path.stat().st_mtime
        with tempfile.NamedTemporaryFile(prefix=f"{path.name}.", suffix=".part",
                                         dir=path.parent) as probe:  # fmt: skip
            now = os.fstat(probe.fileno()).st_mtime
    except FileNotFoundError:
        return None
    return max(0.0, now - renewed)


def _is_stale(holder: dict[str, Any], age: float) -> bool:
    here = _this_process()
    pid = holder.get("pid")
    elsewhere = any(holder.get(key, here[key]) != here[key] for key in ("host", "pids"))
    if "host" not in holder or elsewhere or not isinstance(pid, int):
        return age > STALE_S
    if pid == here["pid"]:  # this process itself, or one that had its number before
        return holder.get("token") not in _HELD
    if not alive(pid):
        return True
    began = _began(pid)
    # the number may have gone to another process since
    return began is not None and holder.get("began") not in (None, began)


def _this_process() -> dict[str, Any]:
    """Where processes have other numbers, as in another container, "pids" differs."""
    try:
        pids: str | None = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        pids = None
    number = os.getpid()
    return {"pid": number, "host": socket.gethostname(), "pids": pids, "began": _began(number)}


def alive(pid: int) -> bool:
    """Whether a process of this number runs on this machine."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it is another user's
        return True
    return True


def _began(pid: int) -> str | None:
    """When a process began, in clock ticks since the machine did; None where that is not known."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()[:8]}/{fields[19]}"
    except (OSError, IndexError, ValueError):
        return None
