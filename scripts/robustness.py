"""The tables of docs/design/robustness.md, from benchmarks/results.

python benchmarks/fuzz.py --json benchmarks/results/fuzz.json
python benchmarks/busy_machine.py --json benchmarks/results/busy-machine.json
python benchmarks/long_run.py --json benchmarks/results/long-run.json
python benchmarks/sanitize.py --json benchmarks/results/sanitize.json
python benchmarks/kill_batch.py --out benchmarks/results/kill-batch.json
python benchmarks/many_rows.py --out benchmarks/results/many-rows.json
python benchmarks/two_gpus.py --out benchmarks/results/two-gpus.json
python scripts/robustness.py
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "design" / "robustness.md"
RESULTS = ROOT / "benchmarks" / "results"


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def fuzz(record: dict[str, Any]) -> str:
    """Cases of each kind of file, and what became of them."""
    rows = [
        [name, f"{t['cases']:,}", f"{t['read']:,}", f"{t['refused']:,}", len(t["wrong"]),
         f"{t['slowest_s']:.1f}"]
        for name, t in record["targets"].items()
    ]  # fmt: skip
    columns = ("files", "cases", "read", "refused", "wrong", "slowest, s")
    minutes = f"{record['seconds'] / 60:.1f} minutes"
    note = f"`{record['command']}`: {record['cases']:,} cases in {minutes}"
    return f"{table(columns, rows)}\n\n{note}, at most {record['peak_gib']} GiB."


def busy(record: dict[str, Any]) -> str:
    """CPU and wall seconds by how threads wait."""
    rows = [
        [r["way"], r["load average before"], r["added"], r["cpu_s"], r["wall_s"]]
        for r in record["rows"]
    ]
    columns = ("threads wait as", "load average before", "busy processes added", "CPU s", "wall s")
    steps = record["steps"] - max(1, record["steps"] // 10)
    return f"{table(columns, rows)}\n\n{steps} steps on {record['cpus']} processors."


def long_run(record: dict[str, Any]) -> str:
    """Readings between a quarter and a third of the steps, and at the end."""
    keys = {
        "memory, MiB": "memory_mib", "file handles": "handles", "a step, ms": "step_ms",
        "Gaussians": "gaussians",
    }  # fmt: skip
    rows = [[what, *(f"{v:g}" for v in record[key])] for what, key in keys.items()]
    made = table(("", "at a quarter to a third", "at the end"), rows)
    return (
        f"{made}\n\nSteps: {record['steps']}, on {record['device']}; {record['checkpoints']} "
        "checkpoints on disk."
    )


def sanitize(record: dict[str, Any]) -> str:
    """What each tool found."""
    rows = [[tool, t["summary"].lower(), t["seconds"]] for tool, t in record["tools"].items()]
    drawn = len(next(iter(record["tools"].values()))["drawn"])
    made = table(("tool", "found", "seconds"), rows)
    return f"{made}\n\n{drawn} renders and scores with gradients under each, on {record['device']}."


def kill_batch(record: dict[str, Any]) -> str:
    """Kills by what was killed, and how often a stage was started and ended."""
    rows = [[kind, kills] for kind, kills in record["kills"].items()]
    made = table(("SIGKILL of a", "times"), rows)
    whole = record["rows"] * record["batches"]
    started = ", ".join(f"{stage} {count}" for stage, count in record["attempts"].items())
    return (
        f"{made}\n\n{record['batches']} batches of {record['rows']} rows, {record['drivers']} "
        f"drivers; started stages, for {whole} rows: {started}. Faults: {len(record['faults'])}."
    )


def many_rows(record: dict[str, Any]) -> str:
    """What the driver of a batch takes, by the number of rows."""
    columns = ("rows", "manifest, s", "a row driven, ms", "a row done before, ms",
               "all folders, s", "summary, s", "peak memory, MiB", "fullest folder")  # fmt: skip
    rows = [
        [f"{r['rows']:,}", r["manifest_s"], r["drive_ms_per_row"], r["done_before_ms_per_row"],
         r["folders_s"], r["summary_s"], r["peak_mib"], f"{r['fullest_folder']:,}"]
        for r in record["measured"]
    ]  # fmt: skip
    last = record["measured"][-1]
    hours = last["rows"] * last["drive_ms_per_row"] / 3.6e6
    driven = f"At most {last['driven']:,} rows were driven; all {last['rows']:,}"
    return f"{table(columns, rows)}\n\n{driven} would take the driver {hours:.1f} h at this rate."


def two_gpus(record: dict[str, Any]) -> str:
    """Seconds of the same batch on one GPU and on two."""
    busy = ", ".join(f"{p:g} %" for p in record["utilisation_percent"].values())
    rows = [["one", record["one_gpu_s"]], ["two", record["two_gpus_s"]]]
    placed = ", ".join(f"{n} on {d}" for d, n in sorted(record["rows_by_device"].items()))
    made, gpus = table(("GPUs", "seconds"), rows), " and ".join(record["gpus"])
    return (
        f"{made}\n\n{record['rows']} rows of {record['steps']} steps on {gpus}: "
        f"{record['times']:.2f} times the throughput; rows: {placed}. "
        f"Mean utilisation while both worked: {busy}."
    )


TABLES = (
    ("two-gpus", "two-gpus.json", two_gpus),
    ("many-rows", "many-rows.json", many_rows),
    ("kill-batch", "kill-batch.json", kill_batch),
    ("fuzz", "fuzz.json", fuzz),
    ("layouts", "fuzz-layouts.json", fuzz),
    ("busy", "busy-machine.json", busy),
    ("long", "long-run.json", long_run),
    ("long-cuda", "long-run-h100.json", long_run),
    ("sanitize", "sanitize.json", sanitize),
)


def main() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for mark, file, make in TABLES:
        if (RESULTS / file).is_file():
            made = make(json.loads((RESULTS / file).read_text(encoding="utf-8")))
            pattern = rf"<!-- {mark} -->.*<!-- /{mark} -->"
            whole = f"<!-- {mark} -->\n{made}\n<!-- /{mark} -->"
            text = re.sub(pattern, lambda _, whole=whole: whole, text, flags=re.S)
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
