"""Throughput of a batch on two GPUs of one machine against one of them.

    python benchmarks/two_gpus.py --out benchmarks/results/two-gpus.json

The same rows are trained, scored and exported by `hoigs batch`, first on the first GPU, one at a
time, then on both, two at a time, after one row has filled the caches. While both work, nvidia-smi
is read twice a second. Exit code 1 below --least times the throughput, or if a GPU had no row.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

CLIP = "builtin:lift-and-swing"


class Utilisation:
    """Means of what nvidia-smi reports while the block runs, percent by GPU."""

    def __enter__(self) -> Utilisation:
        self.readings: dict[str, list[int]] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _read(self) -> None:
        query = ["nvidia-smi", "--query-gpu=index,utilization.gpu", "--format=csv,noheader,nounits"]
        while not self._ended.wait(0.5):
            listed = subprocess.run(query, capture_output=True, text=True, check=True).stdout
            for line in listed.splitlines():
                gpu, _, percent = line.partition(", ")
                self.readings.setdefault(gpu, []).append(int(percent))

    def means(self) -> dict[str, float]:
        return {gpu: round(sum(values) / len(values), 1) for gpu, values in self.readings.items()}


def run_batch(
    folder: Path, name: str, rows: int, gpus: str, steps: int, threads: int, device: str
) -> float:
    """Seconds of a batch of trainings on these GPUs, as many at a time."""
    lines = [
        f"row{i},{CLIP},hoigs,train.steps={steps};train.preview_every=0;train.seed={i},{device},"
        for i in range(rows)
    ]
    text = "\n".join(["name,clip,spec,set,device,export", *lines])
    (folder / f"{name}.csv").write_text(text + "\n")
    count = len(gpus.split(","))
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "hoigs", "batch", str(folder / f"{name}.csv"), "--out",
         str(folder / name), "--jobs", str(count), "--threads", str(threads)],
        env=os.environ | {"CUDA_VISIBLE_DEVICES": gpus}, check=False,
        capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode != 0:
        raise SystemExit(f"{name} failed:\n{done.stdout}{done.stderr}")
    return time.perf_counter() - began


def devices(folder: Path, name: str) -> dict[str, int]:
    """How many rows were trained on each GPU, from the records of the rows."""
    states = (folder / name).glob("rows/*/state.json")
    return dict(Counter(json.loads(s.read_text())["done"]["train"]["device"] for s in states))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, default=4)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--gpus", default="0,1")
    parser.add_argument("--device", default="cuda", help="auto: also without CUDA, to try it")
    parser.add_argument("--least", type=float, default=1.8)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    from hoigs.core.system.threads import available_cpus

    gpus = given.gpus.split(",")
    threads = max(1, available_cpus() // len(gpus))  # the same for one and for two
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        warm_s = run_batch(folder, "warm", 1, gpus[0], 20, threads, given.device)
        one_s = run_batch(folder, "one", given.rows, gpus[0], given.steps, threads, given.device)
        with Utilisation() as read:
            two_s = run_batch(
                folder, "two", given.rows, given.gpus, given.steps, threads, given.device
            )
        rows = devices(folder, "two")
    listed = subprocess.run(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"],
                            capture_output=True, text=True, check=True)  # fmt: skip
    result = {
        "gpus": listed.stdout.splitlines(),
        "rows": given.rows,
        "steps": given.steps,
        "threads": threads,
        "warm_s": round(warm_s, 1),
        "one_gpu_s": round(one_s, 1),
        "two_gpus_s": round(two_s, 1),
        "times": round(one_s / two_s, 3),
        "rows_by_device": rows,
        "utilisation_percent": read.means(),
    }
    print(json.dumps(result, indent=1))
    if given.out:
        given.out.write_text(json.dumps(result, indent=1) + "\n")
    return 0 if result["times"] >= given.least and len(rows) == len(gpus) else 1


if __name__ == "__main__":
    sys.exit(main())
