"""Threads that wait for each other: shortly spinning on an idle machine, asleep on a busy one."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from hoigs.core.system import threads as busy
from hoigs.core.system.threads import available_cpus

NAMES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")


@pytest.mark.parametrize("known", [True, False])
def test_what_commands_set(hoigs, monkeypatch, tmp_path, known):
    for name in NAMES:
        monkeypatch.setenv(name, "")  # what the command sets ends with the test
        monkeypatch.delenv(name)
    (tmp_path / "17").mkdir()
    (tmp_path / "17/schedstat").write_text("5 6 7" if known else "nonsense")
    monkeypatch.setattr(busy, "TASKS", tmp_path)
    assert hoigs("--version").code == 0
    expected = {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": str(available_cpus())}
    expected |= {"GOMP_SPINCOUNT": busy.SHORT_SPIN} if known else {}
    assert {name: os.environ[name] for name in NAMES if name in os.environ} == expected


def test_the_users_own_settings_of_threads_stay(hoigs, monkeypatch):
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    hoigs("--version")
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"
    assert "GOMP_SPINCOUNT" not in os.environ


@pytest.mark.parametrize(
    ("ran", "queued", "short"),
    [(900, 90, False), (900, 110, True), (9, 90, None), (-900, 500, None)],
)
def test_a_machine_is_busy_where_threads_queue(monkeypatch, ran, queued, short):
    """Too little work, or the smaller sum after threads have ended, changes nothing."""
    waiting, changes = busy.Waiting(), []
    monkeypatch.setattr(waiting, "set", changes.append)
    times = iter([(10**10, 10**10), (10**10 + ran * 10**6, 10**10 + queued * 10**6)])
    monkeypatch.setattr(busy, "scheduled", lambda: next(times))
    waiting.look()
    changes.clear()
    waiting.look()
    assert changes == ([] if short is None else [short])


TRIAL = """
import json, os, sys, threading, time
from hoigs.core.system import threads as busy

busy.INTERVAL = 0.2
if "command" in sys.argv:
    busy.share_processors()
import torch

torch.set_num_threads(2)
numbers = torch.rand(200_000, generator=torch.Generator().manual_seed(0))


def measure(seconds):
    began, cpu, sums = time.perf_counter(), time.process_time(), []
    while time.perf_counter() < began + seconds or len(sums) < 5:
        sums.append(float(numbers.sum()))
    return (time.process_time() - cpu) / len(sums), set(sums)


measure(0.1)
one = {min(os.sched_getaffinity(0))}
for task in os.listdir("/proc/self/task"):
    os.sched_setaffinity(int(task), one)
before = measure(0.5)
with busy.short_waits_when_busy(), busy.short_waits_when_busy():
    watchers = [t.name for t in threading.enumerate()].count("hoigs-waits")
    measure(1)
    during = measure(0.5)
left = [t.name for t in threading.enumerate()]
print(json.dumps([before[0], during[0], list(before[1] | during[1]), watchers, left]))
"""


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or available_cpus() < 2 or busy.scheduled() is None,
    reason="needs two processors and /proc/self/task/*/schedstat",
)
@pytest.mark.parametrize("how", ["command", "from Python"])
def test_threads_that_queue_do_not_spin(how):
    """Two threads on one processor: each spins while the other one would have to run."""
    environment = {k: v for k, v in os.environ.items() if k not in NAMES}
    done = subprocess.run(
        [sys.executable, "-c", TRIAL, how],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    before, during, sums, watchers, left = json.loads(done.stdout)
    assert during < before / 3, (before, during)
    assert len(sums) == 1, "as many threads work as before"
    assert watchers == 1 and left == ["MainThread"]


IMPORTS = """
import faulthandler, os
faulthandler.dump_traceback_later(60, exit=True)
from hoigs.core.system import threads as busy

os.environ["GOMP_SPINCOUNT"] = busy.SHORT_SPIN
busy.INTERVAL = 0.0001
busy.Waiting.look = lambda self: self.set(not self.short)
import torch

with busy.short_waits_when_busy():
    from pxr import Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils
"""


def test_extensions_may_take_pythons_lock_while_they_are_loaded():
    pytest.importorskip("pxr", reason="an extension that does: pip install 'hoigs[usd]'")
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
