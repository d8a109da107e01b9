"""A batch on two Ray nodes, a worker and a node killed: done once, and bit for bit the same."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_killed_and_finished(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'hoigs[ray]'")
    out = tmp_path / "kill.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/kill_batch.py", "--rows", "2", "--kills", "2",
         "--out", str(out)],
        cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(out.read_text())
    assert found["kills"] == {"worker": 1, "node": 1, "driver": 0, "head": 0}
    assert found["faults"] == [] and found["batches"] >= 1
