"""Cells of a benchmark: each in its own process, kept at once, and not run again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

SCRIPT = """
import os, sys, time
from pathlib import Path
sys.path.insert(0, {benchmarks!r})
from many_cells import run_cells, write_cell

folder, settings = Path(os.environ["CELLS_OUT"]), {{"steps": int(os.environ["CELLS_STEPS"])}}
if sys.argv[1] == "--cell":
    name = sys.argv[2]
    if name == "bad":
        sys.exit("this one fails")
    time.sleep(30 if name == "slow" else 0)
    with (folder / "ran.txt").open("a") as file:
        file.write(name + "\\n")
    write_cell(folder, name, settings, {{"value": len(name)}})
else:
    left = run_cells(sys.argv[1].split(","), folder, settings, [], jobs=2, threads=1,
                     minutes=float(sys.argv[2]))
    print("left:", ",".join(left))
"""


@pytest.fixture
def cells(tmp_path):
    script, out = tmp_path / "bench.py", tmp_path / "out"
    script.write_text(SCRIPT.format(benchmarks=str(BENCHMARKS)))

    def run(names: str, steps: int = 5, minutes: float = 1.0) -> str:
        command = [sys.executable, str(script), names, str(minutes)]
        environment = {**os.environ, "CELLS_OUT": str(out), "CELLS_STEPS": str(steps)}
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=120, check=True, env=environment
        )
        return done.stdout

    run.out = out
    return run


def ran(cells) -> list[str]:
    return sorted((cells.out / "ran.txt").read_text().split())


def test_what_is_done_is_kept_and_not_done_again(cells):
    said = cells("a,bb,bad,ccc")
    assert said.splitlines()[-1] == "left: bad" and "bad: FAILED" in said
    assert "this one fails" in (cells.out / "bad.log").read_text()
    assert json.loads((cells.out / "bb.json").read_text()) == {
        "settings": {"steps": 5},
        "value": 2,
    }
    assert ran(cells) == ["a", "bb", "ccc"]
    assert "3 of 4 done before" in cells("a,bb,ccc,d")
    assert ran(cells) == ["a", "bb", "ccc", "d"]


def test_other_settings_are_another_result(cells):
    cells("a")
    assert "0 of 1 done before" in cells("a", steps=6)
    assert ran(cells) == ["a", "a"]


def test_time_ends_what_runs(cells):
    said = cells("slow,b", minutes=0.02)
    assert "time is up: 2 left" in said and said.splitlines()[-1] == "left: slow,b"
    assert not (cells.out / "ran.txt").exists()
