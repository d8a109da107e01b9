"""What the driver of a batch costs, at its smallest."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_rows_are_driven_and_counted() -> None:
    command = [sys.executable, "benchmarks/many_rows.py", "--one", "--rows", "50", "--driven", "5"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["rows"], found["driven"], found["fullest_folder"]) == (50, 5, 50)
    assert found["drive_ms_per_row"] > 0 and found["peak_mib"] >= found["peak_mib_before"]
