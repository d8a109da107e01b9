"""Time that the driver of `hoigs batch` spends on a row, with stages that take none.

python benchmarks/batch_overhead.py --rows 50 100 200 --out benchmarks/results/batch_overhead.json
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from hoigs.studies.batch.batch import drive
from hoigs.studies.batch.folder import BatchFolder
from hoigs.studies.batch.manifest import each_row
from hoigs.studies.execution.local import Needs
from hoigs.studies.jobs.cost import cpu_model


class Done:
    """A process that has ended."""

    device, lost = "cpu", False

    def poll(self) -> int:
        return 0

    def stop(self) -> None:
        pass


class Simulated:
    """Makes the result of each stage at once."""

    slots = 2

    def start(self, command: Sequence[str], log: Path, needs: Needs, lease: str) -> Done:
        del log, needs, lease
        words = list(command[1:])
        if words[0] == "eval":
            (Path(words[1]) / "evaluation.json").write_text("{}")
        else:
            Path(words[words.index("--out") + 1]).mkdir(parents=True)
        return Done()


def measure(rows: int) -> dict[str, float]:
    """Milliseconds a row, of wall time and of processor time, with prepare, train, eval, export."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.mp4").touch()
        lines = "".join(f"row{i},a.mp4\n" for i in range(rows))
        (folder / "rows.csv").write_text(f"name,video\n{lines}")
        batch = BatchFolder.begin(folder / "out", each_row(folder / "rows.csv"))
        wall, cpu = time.perf_counter(), time.process_time()
        failed = drive(batch.rows(), batch, Simulated())
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        assert not failed, failed
    return {
        "rows": rows,
        "wall_ms": round(1e3 * wall / rows, 2),
        "cpu_ms": round(1e3 * cpu / rows, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, nargs="+", default=[50, 100, 200])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    result = {"cpu": cpu_model(), "per_row": [measure(rows) for rows in given.rows]}
    text = json.dumps(result, indent=1)
    print(text)
    if given.out:
        given.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
