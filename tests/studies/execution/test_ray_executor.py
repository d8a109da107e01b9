"""RayExecutor: places processes by Ray's resources; they end with cancelling and lost workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.studies.execution.local import Needs, make_executor, why_failed
from hoigs.studies.execution.ray_tasks import RayExecutor

PRINTS = """
import os, sys, time
print(os.getpid(), os.getppid(), os.environ.get("CUDA_VISIBLE_DEVICES"),
      os.environ["OMP_NUM_THREADS"], sys.argv[3], flush=True)
time.sleep(float(sys.argv[4]))
sys.exit(int(sys.argv[5]))
"""


def test_a_missing_ray_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(HoigsError, match=r"hoigs\[ray\]"):
        make_executor("ray")


@pytest.fixture(scope="module")
def ray():
    found = pytest.importorskip("ray", reason="Ray is not installed: pip install 'hoigs[ray]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        found.init(address="local", num_cpus=4, num_gpus=2, include_dashboard=False,
                   log_to_driver=False, _node_ip_address="127.0.0.1")  # fmt: skip
        yield found
        found.shutdown()


@pytest.fixture
def start(ray, tmp_path):
    """Starts a process that prints its environment, and returns it with what it printed."""
    where = RayExecutor(4, program=("-c", PRINTS))
    processes = []

    def begin(seconds: float = 60, code: int = 0, **needs: float):
        log = tmp_path / f"{len(processes)}.log"
        words = ("module", str(seconds), str(code))
        processes.append(where.start(words, log, Needs(**needs)))
        until = time.monotonic() + 30
        while not (log.exists() and log.read_text()) and time.monotonic() < until:
            time.sleep(0.05)
        return processes[-1], log

    yield begin
    for process in processes:
        process.stop()


def wait(process) -> int:
    until = time.monotonic() + 30
    while process.poll() is None and time.monotonic() < until:
        time.sleep(0.05)
    return process.poll()


def gone(pid: int) -> bool:
    until = time.monotonic() + 5
    while Path(f"/proc/{pid}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    return not Path(f"/proc/{pid}").exists()


def test_shares_of_gpus_and_exit_codes(start):
    halves = [start(gpus=0.5)[1].read_text().split()[2:] for _ in range(3)]
    gpus = [words[0] for words in halves]
    assert sorted(gpus) in (["0", "0", "1"], ["0", "1", "1"])
    assert all(words[1:] == ["1", "module"] for words in halves), "4 CPUs for 4 slots"
    process, _ = start(seconds=0, code=3, gpus=0.25)
    assert wait(process) == 3 and not process.lost and process.device.startswith("GPU ")


def test_what_no_machine_has_room_for_is_refused(ray, tmp_path):
    where = RayExecutor(4, threads=1)
    for needs in (Needs(memory_gb=1e6), Needs(gpus=2.5)):
        with pytest.raises(HoigsError, match=r"GPUs|memory"):
            where.start(("module",), tmp_path / "log", needs)
    with pytest.raises(HoigsError, match="99 CPUs"):
        RayExecutor(1, threads=99).start(("module",), tmp_path / "log", Needs(gpus=0))


def test_a_stopped_process_is_gone(start):
    process, log = start(gpus=0)
    process.stop()
    assert process.poll() == -signal.SIGTERM and gone(int(log.read_text().split()[0]))


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_a_process_whose_worker_is_killed_is_begun_again_if_it_may_be(start, tmp_path):
    process, log = start(gpus=0, seconds=1.5, retries=1)
    os.kill(int(log.read_text().split()[1]), signal.SIGKILL)
    assert wait(process) == 0
    assert len(log.read_text().splitlines()) == 2, "two attempts"
    lost, log = start(gpus=0)
    os.kill(int(log.read_text().split()[1]), signal.SIGKILL)
    assert wait(lost) == 1 and lost.lost and "Ray lost the process" in why_failed(log, 1)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_what_hoigs_starts_ends_when_a_worker_is_killed(ray, tmp_path):
    """By the program that runs commands, which finds the module on its path."""
    (tmp_path / "sleeper.py").write_text(
        "import os, time\nprint(os.getpid(), os.getppid(), flush=True)\ntime.sleep(60)\n"
    )
    runs = (
        f"import runpy, sys; sys.path.insert(0, {str(tmp_path)!r}); "
        "runpy.run_module('hoigs.studies.execution.command', run_name='__main__', alter_sys=True)"
    )
    log = tmp_path / "log"
    process = RayExecutor(1, program=("-c", runs)).start(("sleeper",), log, Needs(gpus=0))
    until = time.monotonic() + 30
    while not (log.exists() and log.read_text()) and time.monotonic() < until:
        time.sleep(0.05)
    pid, parent = map(int, log.read_text().split())
    os.kill(parent, signal.SIGKILL)
    assert wait(process) == 1 and gone(pid)


def test_no_cluster_at_an_address(ray):
    """In a process of its own: Ray can be initialised once in each."""
    text = (
        "from hoigs.studies.execution.local import make_executor\n"
        "make_executor('ray', address='127.0.0.1:1')\n"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert "HoigsError: --address 127.0.0.1:1: no Ray cluster answers there" in done.stderr


def test_workers_import_nothing_from_the_folder_where_ray_is_started(ray, tmp_path):
    """In a process of its own: Ray can be initialised once in each."""
    text = (
        "import sys\n"
        "from hoigs.studies.execution.local import make_executor\n"
        "make_executor('ray')\n"
        "import ray\n"
        "print(ray.get(ray.remote(lambda: sys.path).remote()))\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", text], capture_output=True, text=True,
                          check=False, cwd=tmp_path)  # fmt: skip
    assert done.stdout.startswith("['/") and str(tmp_path) not in done.stdout, done.stderr


def test_by_default_nothing_listens_but_on_loopback(ray):
    """In a process of its own, as Ray reads its settings when it is imported."""
    text = (
        "import socket\n"
        "from hoigs.studies.execution.local import make_executor\n"
        "make_executor('ray')\n"
        "import ray\n"
        "host, _, port = ray.get_runtime_context().gcs_address.rpartition(':')\n"
        "assert host == '127.0.0.1', host\n"
        "probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n"
        "try:\n"
        "    probe.connect(('192.0.2.1', 9))  # sends nothing; fails without a network\n"
        "    other = probe.getsockname()[0]\n"
        "    socket.create_connection((other, int(port)), 2)\n"
        "except OSError:\n"
        "    print('refused')\n"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert done.stdout == "refused\n", done.stdout + done.stderr
