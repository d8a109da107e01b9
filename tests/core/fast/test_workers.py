"""Launches on several cores, also where other programs keep these busy."""

from __future__ import annotations

import subprocess
import sys
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import pytest

from hoigs.core.fast.launch import SerialWorkers, ThreadWorkers


class Launch:
    def __init__(self) -> None:
        self.threads: list[str] = []

    def launch(self) -> None:
        self.threads.append(threading.current_thread().name)


def test_every_launch_runs_once() -> None:
    for workers in (SerialWorkers(), ThreadWorkers()):
        launches = [Launch() for _ in range(5)]
        workers.run(launches)
        assert [len(launch.threads) for launch in launches] == [1] * 5


def test_the_caller_does_what_no_worker_has_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(free.wait, 10.0)  # the worker has no time
        monkeypatch.setattr(ThreadWorkers, "_executor", lambda _: pool)
        launches = [Launch() for _ in range(3)]
        ThreadWorkers().run(launches)
        assert not free.is_set()
        free.set()
    caller = threading.current_thread().name
    assert [launch.threads for launch in launches] == [[caller]] * 3


@pytest.mark.parametrize("begun", [False, True])
def test_nothing_of_a_launch_lives_on_in_a_worker(
    begun: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Pool(ThreadPoolExecutor):
        kept: ClassVar[list[object]] = []

        def submit(self, task, /, *args, **kwargs):  # type: ignore[no-untyped-def]
            self.kept.append(task)  # as a thread does that gets no processor again for a while
            future = super().submit(task, *args, **kwargs)
            if begun:
                future.exception()
            return future

    free = threading.Event()
    with Pool(1) as pool:
        if not begun:
            ThreadPoolExecutor.submit(pool, free.wait, 10.0)
        monkeypatch.setattr(ThreadWorkers, "_executor", lambda _: pool)
        launches = [Launch() for _ in range(2)]
        gone = [weakref.ref(launch) for launch in launches]
        ThreadWorkers().run(launches)
        del launches
        assert [ref() for ref in gone] == [None, None] and pool.kept
        free.set()


def test_an_error_of_a_worker_reaches_the_caller() -> None:
    class Broken(Launch):
        def launch(self) -> None:
            raise RuntimeError("no memory")

    with pytest.raises(RuntimeError, match="no memory"):
        ThreadWorkers().run([Launch(), Broken()])


STOPPED = """
import threading
from hoigs.core.fast.launch import ThreadWorkers

start = threading.Thread.start


def stopped(self):
    start(self)
    raise KeyboardInterrupt


class Launch:
    def launch(self):
        pass


threading.Thread.start = stopped
ThreadWorkers().run([Launch(), Launch()])
"""


def test_a_stop_while_a_thread_starts_leaves_none_that_python_waits_for() -> None:
    done = subprocess.run(
        [sys.executable, "-c", STOPPED], capture_output=True, text=True, timeout=60, check=False
    )
    assert "KeyboardInterrupt" in done.stderr
