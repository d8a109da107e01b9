"""LocalExecutor: places processes on GPUs, threads and memory; jobs end with parent and lease."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.execution.local import (
    LocalExecutor,
    Needs,
    Process,
    make_executor,
    visible_gpus,
    why_failed,
)

PRINTS = """
import os, time
print(os.environ.get("CUDA_VISIBLE_DEVICES"), os.environ["OMP_NUM_THREADS"], flush=True)
time.sleep(60)
"""

SLEEPER = """
import time
print("here", flush=True)
time.sleep(60)
"""


def executor(slots: int, **more: object) -> LocalExecutor:
    return LocalExecutor(slots, program=(sys.executable, "-c", PRINTS), **more)  # type: ignore[arg-type]


def printed(log: Path) -> str:
    until = time.monotonic() + 20
    while not (log.exists() and log.read_text()) and time.monotonic() < until:
        time.sleep(0.02)
    return log.read_text().strip()


def runs(pid: int) -> bool:
    try:
        return "zombie" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def assert_killed(process: Process) -> None:
    """Within four seconds, by itself."""
    began = time.monotonic()
    while process.poll() is None and time.monotonic() < began + 10:
        time.sleep(0.02)
    assert process.poll() == -9 and time.monotonic() - began < 4


class Starts:
    """Starts processes that print their environment and stay until they are stopped."""

    def __init__(self, where: LocalExecutor, folder: Path) -> None:
        self.where, self.folder, self.processes = where, folder, []

    def __call__(self, **needs: float) -> tuple[Process | None, str]:
        log = self.folder / f"{len(self.processes)}.log"
        process = self.where.start(("module",), log, Needs(**needs))  # type: ignore[arg-type]
        self.processes.append(process)
        return process, printed(log) if process else ""


@pytest.fixture
def two_gpus(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0, 1")


@pytest.fixture
def starts(tmp_path, two_gpus):
    made = []

    def make(slots: int, **more: object) -> Starts:
        made.append(Starts(executor(slots, threads=3, **more), tmp_path))
        return made[-1]

    yield make
    for process in (process for one in made for process in one.processes):
        if process is not None:
            process.stop()


def test_processes_take_the_gpus_in_turn(starts):
    start = starts(2)
    (first, seen), (second, also) = start(), start()
    assert (seen, also) == ("0 3", "1 3")
    assert first.device == "GPU 0" and second.device == "GPU 1"
    assert start() == (None, "")
    first.stop()
    assert start()[1] == "0 3", "the free one"


@pytest.mark.parametrize(("slots", "gpus"), [(2, "010"), (3, "0101"), (4, "0101")])
def test_more_processes_than_gpus_share_them_evenly(starts, slots, gpus):
    start = starts(slots)
    assert [start()[1][:1] for _ in range(slots)] == list(gpus[:slots])


def test_shares_of_a_gpu_fill_it_and_no_more(starts):
    start = starts(8)
    taken = [start(gpus=share)[1][:1] for share in (0.5, 0.75, 0.25, 0.25, 0.5, 0.25)]
    assert taken == ["0", "1", "0", "1", "", "0"], "0.5 has no room anywhere"
    assert start(gpus=0)[1] == "0, 1 3", "what computes on no GPU is not placed"
    with pytest.raises(HoigsError, match="from 0 to 1"):
        start(gpus=2)


def test_memory_is_set_aside(starts):
    start = starts(4, memory_gb=10)
    assert start(memory_gb=6)[0] and start(memory_gb=6)[0] is None and start(memory_gb=4)[0]
    with pytest.raises(HoigsError, match=r"\b11\b.*\b10\b"):
        start(memory_gb=11)


def test_gpus_of_the_environment(monkeypatch):
    for text, gpus in (("", []), ("-1", []), ("3", ["3"]), ("GPU-a,GPU-b", ["GPU-a", "GPU-b"])):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", text)
        assert visible_gpus() == gpus


def test_a_process_ends_when_its_lease_is_anothers(tmp_path, monkeypatch):
    """Even while its driver is suspended: it looks for itself."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    where, lock = LocalExecutor(), FolderLock(tmp_path / "row", "hoigs batch").acquire()
    process = where.start(("sleeper",), tmp_path / "log", Needs(), lock.lease)
    try:
        assert printed(tmp_path / "log") == "here"
        time.sleep(1.5)
        assert process.poll() is None, "it looks at the lease once a second"
        lock.path.unlink()
        FolderLock(tmp_path / "row", "another").acquire()
        assert_killed(process)
    finally:
        process.stop()
    assert "another one has taken this work over" in (tmp_path / "log").read_text()


HOLDER = """
import sys, time
from pathlib import Path
from hoigs.core.system.folder_lock import FolderLock
lock = FolderLock(Path(sys.argv[1]), "hoigs batch").acquire()
print(lock.lease, flush=True)
time.sleep(60)
"""


def test_a_process_ends_with_its_driver_though_its_parent_lives(tmp_path, monkeypatch):
    """As where both the driver and the head of a Ray cluster are killed."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    words = [sys.executable, "-c", HOLDER, str(tmp_path / "row")]
    driver = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert driver.stdout is not None
    lease = driver.stdout.readline().strip()
    process = LocalExecutor().start(("sleeper",), tmp_path / "log", Needs(), lease)
    try:
        assert printed(tmp_path / "log") == "here"
        time.sleep(1.5)
        assert process.poll() is None
        driver.kill()
        driver.communicate()
        assert_killed(process)
    finally:
        driver.kill()
        process.stop()


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_stop_ends_what_a_process_started(tmp_path):
    text = "import subprocess, time\nprint(subprocess.Popen(['sleep', '60']).pid, flush=True)\n"
    where = LocalExecutor(program=(sys.executable, "-c", f"{text}time.sleep(60)"))
    process = where.start(("module",), tmp_path / "log", Needs())
    child = int(printed(tmp_path / "log"))
    process.stop()
    until = time.monotonic() + 10  # the system takes a moment to end what has got SIGKILL
    while runs(child) and time.monotonic() < until:
        time.sleep(0.02)
    assert not runs(child)
    assert process.poll() == -15


def test_executors_are_named(tmp_path, monkeypatch):
    assert isinstance(make_executor("local", 3), LocalExecutor)
    with pytest.raises(HoigsError, match=r'locale.*"local".*ray'):
        make_executor("locale")
    with pytest.raises(HoigsError, match="auto"):
        make_executor("local", address="auto")
    with pytest.raises(HoigsError, match="nowhere:Mine"):
        make_executor("nowhere:Mine")
    (tmp_path / "own_executor.py").write_text(
        "class Mine:\n    def __init__(self, slots, threads, address):\n"
        "        self.slots, self.address = slots, address\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    made = make_executor("own_executor:Mine", 2, address="host")
    assert (made.slots, made.address) == (2, "host")  # type: ignore[attr-defined]


def test_the_reason_of_a_failure_is_the_last_error(tmp_path):
    log = tmp_path / "log"
    log.write_text("begun\nerror: no such clip\n  here\n")
    assert (
        why_failed(log, 2) == "no such clip   here" and why_failed(log, -9) == "ended by signal 9"
    )
    log.write_text("")
    assert why_failed(log, 1) == "exit code 1, and an empty log"


def test_a_command_is_run_with_its_own_words(tmp_path):
    """`hoigs` by the program that executors run; its parent is this process."""
    words = [str(os.getpid()), "", "hoigs", "--version"]
    done = subprocess.run([sys.executable, "-m", "hoigs.studies.execution.command", *words],
                          capture_output=True, text=True, check=False,
                          start_new_session=True)  # fmt: skip
    assert done.returncode == 0 and done.stdout.startswith("hoigs "), done.stderr
