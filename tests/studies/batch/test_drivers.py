"""Drivers of one batch at the same time, and drivers and stages that are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import hoigs
from hoigs.studies.execution.local import LocalExecutor

# in place of `hoigs`: notes its start and end, and makes what the stage would make
STAGE = """
import os, sys, time
from pathlib import Path
from hoigs.studies.execution.command import end_with
end_with(int(sys.argv[1]), sys.argv[2])
words = sys.argv[4:]
def note(text):
    with open(os.environ["HOIGS_TEST_NOTES"], "a") as file:
        file.write(f"{text} {words[0]} {target.parent.name} {os.getpid()}\\n")
target = Path(words[words.index("--out") + 1] if "--out" in words else words[1])
if words[0] == "export":
    target = target.parent
note("start")
if "broken" in str(target):
    sys.exit("error: this one is broken")
time.sleep(float(os.environ["HOIGS_TEST_SECONDS"]))
if words[0] == "export":
    (target / words[words.index("--format") + 1]).mkdir(parents=True)
elif words[0] == "eval":
    (target / "evaluation.json").write_text("{}")
else:
    target.mkdir(exist_ok=True)
note("end")
"""
DRIVER = """
import sys
import hoigs
from hoigs.studies.execution.local import LocalExecutor
from hoigs.studies.execution.ray_tasks import RayExecutor
if len(sys.argv) > 4:
    where = RayExecutor(2, threads=1, address=sys.argv[4], program=(sys.argv[1],))
else:
    where = LocalExecutor(2, program=(sys.executable, sys.argv[1]))
done = hoigs.batch(sys.argv[2], sys.argv[3], executor=where)
sys.exit(len(done.failed))
"""


class Batches:
    """Starts drivers on one folder."""

    def __init__(self, folder: Path, rows: list[str]) -> None:
        self.folder, self.out, self.notes = folder, folder / "out", folder / "notes"
        (folder / "clip").mkdir()
        (folder / "stage.py").write_text(STAGE)
        text = "".join(f"  - {{name: {row}, clip: clip}}\n" for row in rows)
        (folder / "rows.yaml").write_text(f"rows:\n{text}")

    def start(self, seconds: float = 0.1, address: str = "") -> subprocess.Popen[bytes]:
        """A driver, with processes on the Ray cluster at an address, or on this machine."""
        names = [str(self.folder / name) for name in ("stage.py", "rows.yaml")]
        environment = os.environ | {
            "HOIGS_TEST_NOTES": str(self.notes), "HOIGS_TEST_SECONDS": str(seconds),
        }  # fmt: skip
        words = [*names, str(self.out), *([address] if address else [])]
        return subprocess.Popen([sys.executable, "-c", DRIVER, *words], env=environment)

    def noted(self) -> list[list[str]]:
        return (
            [x.split() for x in self.notes.read_text().splitlines()] if self.notes.exists() else []
        )

    def wait_for(self, event: str, stage: str) -> int:
        """The process of the first such event."""
        until = time.monotonic() + 30
        while time.monotonic() < until:
            for what, name, _, pid in self.noted():
                if (what, name) == (event, stage):
                    return int(pid)
            time.sleep(0.02)
        raise AssertionError(f"no {event} of {stage} in {self.noted()}")

    def ends(self) -> Counter[tuple[str, str]]:
        return Counter((stage, row) for what, stage, row, _ in self.noted() if what == "end")

    def states(self) -> dict[str, str]:
        return {
            row["name"]: row["state"] for row in json.loads((self.out / "summary.json").read_text())
        }


def all_gone(pids: list[int]) -> bool:
    until = time.monotonic() + 5
    while time.monotonic() < until:
        if not any(Path(f"/proc/{pid}").exists() for pid in pids):
            return True
        time.sleep(0.05)
    return False


@pytest.fixture(params=["local", "ray"])
def address(request, monkeypatch):
    """Of a Ray cluster of this machine, or empty."""
    if request.param == "local":
        yield ""
        return
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'hoigs[ray]'")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 4})
    yield cluster.address
    cluster.shutdown()


def test_two_drivers_do_every_stage_once_and_a_failed_row_costs_only_itself(tmp_path, address):
    batches = Batches(tmp_path, ["a", "b", "broken", "c"])
    first, second = (batches.start(address=address) for _ in range(2))
    assert first.wait(60) == 1 and second.wait(60) == 1
    assert set(batches.ends().values()) == {1} and len(batches.ends()) == 9
    assert batches.states() == {"a": "done", "b": "done", "broken": "failed", "c": "done"}
    assert "this one is broken" in (batches.out / "rows/broken/train.log").read_text()
    assert not [p for p in batches.out.rglob("*") if p.suffix in (".part", ".lock")]


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("victim", ["driver", "stage"])
def test_after_a_kill_every_row_is_done_once(tmp_path, victim):
    batches = Batches(tmp_path, ["a", "b"])
    driver = batches.start(seconds=1.0)
    stage = batches.wait_for("start", "train")
    os.kill(driver.pid if victim == "driver" else stage, signal.SIGKILL)
    if victim == "driver":
        assert driver.wait(10) == -signal.SIGKILL
        assert all_gone([int(pid) for *_, pid in batches.noted()])  # no stage outlives its driver
        driver = batches.start(seconds=0.1)
    assert driver.wait(60) == 0
    assert set(batches.ends().values()) == {1} and len(batches.ends()) == 6
    assert set(batches.states().values()) == {"done"}
    assert not [p for p in batches.out.rglob("*") if p.suffix in (".part", ".lock")]
    assert all_gone([int(pid) for *_, pid in batches.noted()])


def test_two_drivers_in_threads_of_one_process(tmp_path, monkeypatch):
    batches = Batches(tmp_path, ["a", "b", "c"])
    monkeypatch.setenv("HOIGS_TEST_NOTES", str(batches.notes))
    monkeypatch.setenv("HOIGS_TEST_SECONDS", "0.1")

    def drive(_: int) -> hoigs.batch:
        where = LocalExecutor(2, program=(sys.executable, str(tmp_path / "stage.py")))
        return hoigs.batch(tmp_path / "rows.yaml", batches.out, executor=where)

    with ThreadPoolExecutor(2) as pool:
        assert [done.failed for done in pool.map(drive, range(2))] == [{}, {}]
    assert set(batches.ends().values()) == {1} and len(batches.ends()) == 9


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_a_driver_whose_lease_is_taken_stops_its_stage_at_once(tmp_path):
    batches = Batches(tmp_path, ["a"])
    driver = batches.start(seconds=60)
    try:
        stage = batches.wait_for("start", "train")
        lock = batches.out / "rows" / ".a.lock"
        record = json.loads(lock.read_text()) | {"token": "its", "pid": os.getpid()}
        lock.with_suffix(".new").write_text(json.dumps(record | {"began": None}))
        lock.with_suffix(".new").replace(lock)
        assert all_gone([stage]) and driver.poll() is None
        assert not batches.ends(), "it was killed while it worked"
    finally:
        driver.terminate()
        driver.wait(20)
    assert json.loads(lock.read_text())["token"] == "its"


def test_what_goes_wrong_with_a_row_is_on_its_record(tmp_path):
    """More memory than the machine has, and a damaged record."""
    batches = Batches(tmp_path, ["big", "spoilt", "fine"])
    rows = tmp_path / "rows.yaml"
    rows.write_text(rows.read_text().replace("name: big,", "name: big, memory_gb: 1000000,"))
    spoilt = batches.out / "rows/spoilt/state.json"
    spoilt.parent.mkdir(parents=True)
    spoilt.write_text("{")
    assert batches.start().wait(60) == 2
    found = {r["name"]: r for r in json.loads((batches.out / "summary.json").read_text())}
    assert [found[n]["state"] for n in ("big", "spoilt", "fine")] == ["failed", "failed", "done"]
    assert "damaged" in found["spoilt"]["why"] and "memory_gb" in found["big"]["why"]
    assert json.loads((batches.out / "rows/big/state.json").read_text())["failed"]["why"]


class Ended:
    """A process that has ended, or was lost with its machine."""

    device = "elsewhere"

    def __init__(self, code: int, lost: bool) -> None:
        self.code, self.lost = code, lost

    def poll(self) -> int:
        return self.code

    def stop(self) -> None:
        pass


@pytest.mark.parametrize(("losses", "state"), [(3, "done"), (4, "failed")])
def test_a_machine_that_is_lost_is_no_failure_of_a_stage(tmp_path, monkeypatch, losses, state):
    monkeypatch.setattr("hoigs.studies.batch.batch.RETRY_S", 0.0)
    batches = Batches(tmp_path, ["a"])

    class Losing:
        slots = 1

        def start(self, command, log, needs, lease):
            words = list(command[1:])
            target = Path(words[words.index("--out") + 1] if "--out" in words else words[1])
            self.started = getattr(self, "started", 0) + 1
            if self.started <= losses:
                log.write_text("error: Ray lost the process\n")
                return Ended(1, lost=True)
            target.mkdir(parents=True, exist_ok=True)
            (target / "evaluation.json").write_text("{}")
            return Ended(0, lost=False)

    done = hoigs.batch(tmp_path / "rows.yaml", batches.out, executor=Losing(), retries=0)
    assert batches.states() == {"a": state}
    assert list(done.failed.values()) == (["Ray lost the process"] if state == "failed" else [])
