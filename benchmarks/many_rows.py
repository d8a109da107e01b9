"""What the driver of `hoigs batch` costs with up to a million rows, whose stages take no time.

    python benchmarks/many_rows.py --out benchmarks/results/many-rows.json

Each number of rows is measured in a process of its own: reading and checking the manifest, driving
rows (no more than --driven, as a million would take hours), looking at rows that are done, a folder
for every row, the summary, the peak of memory, and how many folders the fullest folder has.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

from batch_overhead import Simulated  # beside this script

from hoigs.studies.batch.batch import drive
from hoigs.studies.batch.folder import BatchFolder
from hoigs.studies.batch.manifest import each_row
from hoigs.studies.batch.summary import write_summary
from hoigs.studies.jobs.cost import cpu_model


class Many(Simulated):
    """As many at a time as a cluster has, so that the driver never waits."""

    slots = 200


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    return work(), time.perf_counter() - began


def make_folders(batch: BatchFolder) -> None:
    for row in batch.rows():
        batch.of(row).mkdir(exist_ok=True)


def peak_mib() -> float:
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def measure(rows: int, driven: int) -> dict[str, float]:
    """Seconds and milliseconds a row with so many rows, of which `driven` are driven."""
    driven = min(rows, driven)
    before = peak_mib()
    with tempfile.TemporaryDirectory() as name:
        manifest = Path(name) / "rows.csv"
        with manifest.open("w") as file:
            file.write("name,clip\n")
            file.writelines(f"row{i:07d},builtin:carry\n" for i in range(rows))
        batch, manifest_s = timed(lambda: BatchFolder.begin(Path(name) / "out", each_row(manifest)))
        failed, drive_s = timed(lambda: drive(islice(batch.rows(), driven), batch, Many()))
        assert not failed, failed
        _, again_s = timed(lambda: drive(islice(batch.rows(), driven), batch, Many()))
        _, folders_s = timed(lambda: make_folders(batch))
        _, summary_s = timed(lambda: write_summary(batch))
        places = [batch.path / "rows"]
        if batch.fan_out:
            places = list(places[0].iterdir())
        fullest = max(sum(1 for _ in place.iterdir()) for place in places)
    return {
        "rows": rows,
        "driven": driven,
        "manifest_s": round(manifest_s, 2),
        "drive_ms_per_row": round(1e3 * drive_s / driven, 2),
        "done_before_ms_per_row": round(1e3 * again_s / driven, 3),
        "folders_s": round(folders_s, 2),
        "summary_s": round(summary_s, 2),
        "peak_mib": peak_mib(),
        "peak_mib_before": before,
        "fullest_folder": fullest,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, nargs="+", default=[1_000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--driven", type=int, default=10_000)
    parser.add_argument("--one", action="store_true", help="measure in this process")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(measure(given.rows[0], given.driven)))
        return
    found = []
    for rows in given.rows:
        command = [sys.executable, __file__, "--one", "--rows", str(rows),
                   "--driven", str(given.driven)]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found.append(json.loads(done.stdout))
        print(done.stdout, end="", flush=True)
    if given.out:
        result = {"cpu": cpu_model(), "measured": found}
        given.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
