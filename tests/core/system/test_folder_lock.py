"""FolderLock: one writer at a time; what dead processes and silent machines left is taken over."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import STALE_S, FolderLock, _began

SCRIPT = """
import sys, time
from pathlib import Path
from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import FolderLock
try:
    with FolderLock(Path(sys.argv[1]), "racing"):
        time.sleep(1.0)
        print("held")
except HoigsError:
    print("refused")
"""


def lock_of(folder: Path, age: float = 0, **record: object) -> Path:
    """A lock that another process has made."""
    path = folder.with_name(f".{folder.name}.lock")
    text = {"work": "training", "token": "its", "host": socket.gethostname(), "pid": os.getppid()}
    path.write_text(json.dumps(text | record))
    os.utime(path, (path.stat().st_atime, path.stat().st_mtime - age))
    return path


def test_a_lock_is_gone_with_the_parents_that_it_made(tmp_path):
    with FolderLock(tmp_path / "a" / "b" / "run", "training"):
        assert (tmp_path / "a" / "b" / ".run.lock").is_file()
    assert not list(tmp_path.iterdir())
    with FolderLock(tmp_path / "a" / "run", "training"):
        (tmp_path / "a" / "run").mkdir()
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["run"]


def test_a_lock_that_a_full_disk_does_not_take_is_gone(tmp_path, monkeypatch):
    def full(file: int, *_: object, **__: object) -> None:
        os.close(file)
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fdopen", full)
        with pytest.raises(OSError) as caught:
            FolderLock(tmp_path / "new/run", "training").acquire()
    assert caught.value.filename == str(tmp_path / "new/.run.lock")
    assert not list(tmp_path.iterdir())
    FolderLock(tmp_path / "new/run", "training").acquire().release()


@pytest.mark.parametrize(
    "record",
    [
        {},
        {"host": "elsewhere", "pid": 1},
        {"pids": "pid:[1]", "pid": 2**22 + 1},  # of another container with this host's name
    ],
)
def test_a_living_process_keeps_its_lock(tmp_path, record):
    path = lock_of(tmp_path / "run", **record)
    with pytest.raises(HoigsError, match=r"being written by another process \(training, pid"):
        FolderLock(tmp_path / "run", "training").acquire()
    assert json.loads(path.read_text())["token"] == "its"
    assert [p.name for p in tmp_path.iterdir()] == [".run.lock"]


@pytest.mark.parametrize(
    ("age", "record"),
    [
        (STALE_S + 5, {"host": "elsewhere"}),
        (STALE_S + 5, {"host": None, "pid": "?"}),
        (0, {"pid": 2**22 + 1}),  # beyond every pid
        (0, {"began": "another-boot/1"}),  # the number belongs to another process now
    ],
)
def test_a_stale_lock_is_taken_over(tmp_path, age, record):
    lock_of(tmp_path / "run", age, **record)
    with FolderLock(tmp_path / "run", "training"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_holder_whose_lock_was_taken_over_finds_out(tmp_path):
    lock = FolderLock(tmp_path / "run", "training").acquire()
    path = lock_of(tmp_path / "run")
    assert lock.is_lost()
    with pytest.raises(HoigsError, match="another process took this folder over"):
        lock.require_held()
    lock.release()
    assert path.is_file()  # it is the other one's


def test_threads_of_one_process_exclude_each_other(tmp_path):
    """One of eight holds it; the others are refused, and then it is free."""
    inside, most, refused = [], [], []
    start = threading.Barrier(8)

    def race(number: int) -> None:
        start.wait()
        try:
            with FolderLock(tmp_path / "run", "training") as lock:
                inside.append(number)
                most.append(len(inside))
                time.sleep(0.05)
                lock.require_held()
                inside.remove(number)
        except HoigsError as error:
            refused.append(str(error))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(race, range(8)))
    assert set(most) == {1} and refused and not list(tmp_path.iterdir())
    assert any("by this process itself (training, pid" in text for text in refused)


def test_a_lock_whose_record_is_still_being_written_names_its_holder(tmp_path):
    path = tmp_path / ".run.lock"
    with FolderLock(tmp_path / "other", "training") as other:
        record = other.path.read_text()
        path.touch()
        writing = threading.Timer(0.05, path.write_text, [record])
        writing.start()
        with pytest.raises(HoigsError, match=r"this process itself \(training, pid"):
            FolderLock(tmp_path / "run", "scoring").acquire()
        writing.join()
    path.unlink()


def test_work_inside_a_lock_names_its_token(tmp_path):
    with FolderLock(tmp_path / "run", "training") as outer:
        with pytest.raises(HoigsError, match="this process itself"):
            FolderLock(tmp_path / "run", "scoring").acquire()
        with FolderLock(tmp_path / "run", "scoring", token=outer.token) as inner:
            assert inner.token == outer.token
        outer.require_held()
        assert not outer.is_lost()
        with pytest.raises(HoigsError, match="another process took this folder over"):
            FolderLock(tmp_path / "run", "scoring", token="another").acquire()
    assert not list(tmp_path.iterdir())


def test_what_this_process_left_without_a_holder_is_taken_over(tmp_path):
    """As after a fork, or where the number was another process's before."""
    lock_of(tmp_path / "run", pid=os.getpid(), began=_began(os.getpid()))
    with FolderLock(tmp_path / "run", "training") as lock:
        lock.path.unlink()
        assert lock.is_lost()


def test_of_processes_at_the_same_time_one_gets_a_stale_lock(tmp_path):
    lock_of(tmp_path / "run", STALE_S + 5, host="elsewhere")
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "run")]

    def race(_: int) -> str:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    with ThreadPoolExecutor(4) as pool:
        # one that starts after the others have ended may get it too
        assert "held" in (outcomes := list(pool.map(race, range(4))))
    assert set(outcomes) <= {"held", "refused"} and not list(tmp_path.iterdir())
