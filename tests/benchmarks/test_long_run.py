"""The long training at its smallest: what it reads, and that checkpoints are thinned."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_nothing_grows(tmp_path: Path) -> None:
    out = tmp_path / "long.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/long_run.py", "--steps", "60", "--width", "16",
         "--json", str(out)],
        cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert out.exists(), done.stderr
    found = json.loads(out.read_text())
    assert found["steps"] == "60 of 60" and len(found["rows"]) > 50
    # a step's time is not judged here: sixty of them on a shared machine say nothing
    assert {k: v for k, v in found["flat"].items() if k != "step"} == {
        "memory": True, "handles": True, "checkpoints": True,
    }  # fmt: skip
    assert 0 < found["checkpoints"] <= 3 and all(row["memory"] > 0 for row in found["rows"])
