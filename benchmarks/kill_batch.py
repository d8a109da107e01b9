"""SIGKILL a batch on a Ray cluster at random moments, and see that nothing is lost or done twice.

    python benchmarks/kill_batch.py --out benchmarks/results/kill-batch.json
    python benchmarks/kill_batch.py --rows 4 --kills 4

The cluster has two logical nodes on this machine, one task on each at a time. An unbroken batch
comes first. The same batch is then killed at random moments, in turn a Ray worker, a node, the
driver, and the head: a lost node is replaced, a lost head by a new cluster, and a driver is started
again. A batch that completes is compared with the unbroken one, bit for bit, and begun anew until
there have been enough kills. Exit code 1 when anything is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

CLIP = (
    "builtin:lift-and-swing?frames=6&width=32&height=32&fps=3&samples=1&edge_samples=1"
    "&held_out_views=0&test_frames=2&scene_points=400&object_points=60"
)
TINY = ("train.steps=4", "train.checkpoint_every=1", "train.log_every=1", "train.preview_every=0",
        "model.scene.points=100")  # fmt: skip
KINDS = ("worker", "node", "driver", "head")
STAGES = ("train", "eval", "export-ply")
ENDING_S = 5.0  # for stages to end after what they belong to was killed


@dataclass
class Kills:
    """What happened.

    Attributes:
        kills: by what was killed. batches: that completed. attempts: started stages by name.
        faults: what was wrong, empty when all is well.
    """

    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    drivers: int = 0
    batches: int = 0
    attempts: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        return sum(self.kills.values())


class TwoNodes:
    """A Ray cluster of two logical nodes with one processor each."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        self._cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        self._other = self._cluster.add_node(num_cpus=1)
        self.address = self._cluster.address

    def kill_node(self) -> None:
        """Kill the raylet of the node without the head, and start another node."""
        _kill(self._other, "raylet")
        self._cluster.remove_node(self._other, allow_graceful=False)
        self._other = self._cluster.add_node(num_cpus=1)

    def kill_head(self) -> None:
        """Kill the server of the cluster and the raylet beside it; all else of it follows."""
        _kill(self._cluster.head_node, "gcs_server")
        _kill(self._cluster.head_node, "raylet")

    def remove(self) -> None:
        for node in list(self._cluster.list_all_nodes()):
            node.kill_all_processes(check_alive=False, allow_graceful=False)


def _kill(node: Any, name: str) -> None:
    for started in node.all_processes[name]:
        started.process.send_signal(signal.SIGKILL)


class Campaign:
    """Batches that are killed, in one folder."""

    def __init__(self, folder: Path, rows: int, kills: int, seed: int) -> None:
        self.folder, self.rows, self.wanted = folder, rows, kills
        self.chance, self.record = random.Random(seed), Kills()
        settings = ";".join(TINY)
        lines = [f"row{i:02d},{CLIP},static,{settings};train.seed={i},cpu,ply" for i in range(rows)]
        text = "\n".join(["name,clip,spec,set,device,export", *lines])
        (folder / "rows.csv").write_text(text + "\n")
        self.cluster = TwoNodes()

    def start(self, out: Path) -> subprocess.Popen[bytes]:
        self.record.drivers += 1
        with (self.folder / f"{out.name}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "hoigs", "batch", str(self.folder / "rows.csv"),
                 "--out", str(out), "--jobs", "2", "--threads", "1", "--retries", "9",
                 "--executor", "ray", "--address", self.cluster.address],
                stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def unbroken(self, out: Path) -> float:
        """Seconds of a batch that is left alone."""
        began = time.perf_counter()
        code = self.start(out).wait()
        if code != 0:
            raise SystemExit(f"the unbroken batch failed: see {self.folder / out.name}.log")
        return time.perf_counter() - began

    def broken(self, out: Path, whole: Path, pause: float) -> None:
        """One batch, killed about every `pause` seconds while there are kills left."""
        driver = self.start(out)
        while True:
            if self.record.count < self.wanted:
                self._wait(driver, self.chance.uniform(0.2 * pause, 1.8 * pause))
            else:
                driver.wait()
            if driver.poll() is not None:
                if driver.returncode == 0:
                    break
                if driver.returncode != -signal.SIGKILL:
                    self.record.faults.append(f"exit code {driver.returncode} of a driver")
                    return
            else:
                driver = self._kill(KINDS[self.record.count % len(KINDS)], driver, out)
        self.record.batches += 1
        self.record.faults += [*faults(out, whole, self.rows), *self._left(out)]
        for folder in sorted((out / "rows").iterdir()):
            for name, count in json.loads((folder / "state.json").read_text())["attempts"].items():
                self.record.attempts[name] = self.record.attempts.get(name, 0) + count

    def _wait(self, driver: subprocess.Popen[bytes], seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until and driver.poll() is None:
            time.sleep(0.05)

    def _kill(
        self, kind: str, driver: subprocess.Popen[bytes], out: Path
    ) -> subprocess.Popen[bytes]:
        """Kill one thing; the driver that goes on."""
        if kind == "worker":
            workers = [_parent(pid) for pid in stages_of(out)]
            if not workers:
                return driver  # between two stages: another moment
            os.kill(self.chance.choice(workers), signal.SIGKILL)
        self.record.kills[kind] += 1
        print(f"kill {self.record.count}: {kind}", flush=True)
        if kind == "node":
            self.cluster.kill_node()
        if kind == "head":
            self.cluster.kill_head()
            self._wait(driver, ENDING_S)
        if kind in ("driver", "head"):
            if driver.poll() is None:
                driver.send_signal(signal.SIGKILL)
            driver.wait()
            self.record.faults += self._left(out)
        if kind == "head":
            self.cluster.remove()
            self.cluster = TwoNodes()
        return self.start(out) if driver.poll() is not None else driver

    def _left(self, out: Path) -> list[str]:
        """Stages that still run although nothing waits for them."""
        until = time.monotonic() + ENDING_S
        while (left := list(stages_of(out))) and time.monotonic() < until:
            time.sleep(0.05)
        return [f"orphan {pid} after kill {self.record.count}" for pid in left]


def stages_of(out: Path) -> Iterator[int]:
    """Processes of stages that write below `out`."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"hoigs.studies.execution.command" in words and any(
            word.startswith(f"{out}/rows/".encode()) for word in words
        ):
            yield int(path.parent.name)


def _parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def faults(out: Path, whole: Path, rows: int) -> list[str]:
    """In what a batch that was killed differs from the unbroken one, and what it left."""
    found = [f"half or locked: {p}" for p in out.rglob("*")
             if p.suffix in (".part", ".lock", ".folder") or ".part." in p.name]  # fmt: skip
    names = sorted(p.name for p in (out / "rows").iterdir())
    if len(names) != rows:
        return [*found, f"{len(names)} rows, not {rows}"]
    ended = Counter(
        line.removesuffix(" done")
        for line in (out.parent / f"{out.name}.log").read_text().splitlines()
        if line.partition(": ")[2] in {f"{stage} done" for stage in STAGES}
    )
    found += [f"{name}: ended {count} times" for name, count in ended.items() if count > 1]
    for name in names:
        ours, theirs = out / "rows" / name, whole / "rows" / name
        state = json.loads((ours / "state.json").read_text())
        if tuple(state["done"]) != STAGES or state["failed"]["why"]:
            found.append(f"{name}: {state}")
            continue
        found += [f"{name}: {fault}" for fault in _differences(ours, theirs)]
    return found


def _differences(ours: Path, theirs: Path) -> list[str]:
    from kill_train import differences  # beside this script

    found = differences(ours / "run", theirs / "run")
    files = [f / "exports" / "ply" / "scene.ply" for f in (ours, theirs)]
    if files[0].read_bytes() != files[1].read_bytes():
        found.append("scene.ply differs")
    scores = [json.loads((f / "run" / "evaluation.json").read_text()) for f in (ours, theirs)]
    keys = ("scores", "geometry", "size", "frames")
    return found + [f"{key} of the evaluation differ" for key in keys
                    if scores[0][key] != scores[1][key]]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, default=24)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON of the result")
    given = parser.parse_args()
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}
    folder = Path(tempfile.mkdtemp(prefix="kill-batch-"))
    campaign = Campaign(folder, given.rows, given.kills, given.seed)
    record = campaign.record
    try:
        seconds = campaign.unbroken(folder / "whole")
        print(f"unbroken: {seconds:.0f} s", flush=True)
        while record.count < given.kills and not record.faults:
            shutil.rmtree(folder / "killed", ignore_errors=True)
            (folder / "killed.log").unlink(missing_ok=True)
            campaign.broken(folder / "killed", folder / "whole", seconds / given.kills)
    finally:
        campaign.cluster.remove()
    result = {"rows": given.rows, "unbroken_s": round(seconds, 1), **asdict(record)}
    print(json.dumps(result, indent=1))
    if record.faults:
        print(f"logs: {folder}")
        return 1
    shutil.rmtree(folder)
    if given.out:
        given.out.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
