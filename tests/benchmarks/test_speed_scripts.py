"""Frame rate and training speed on a few splats: that the scripts run and what they write."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
TINY = ["--device", "cpu", "--size", "64x36", "--splats", "200", "100", "50", "--frames", "6"]


def report(script: str, out: Path, *more: str) -> dict[str, Any]:
    command = [sys.executable, f"benchmarks/{script}.py", *TINY, *more, "--json", str(out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(out.read_text())


def test_frame_rate(tmp_path: Path) -> None:
    found = report("frame_rate", tmp_path / "rate.json", "--sweep", "3", "--rounds", "1")
    film = found["ways"].pop("film")
    assert film["fps"] > 0 and set(found["ways"]) == {"plain", "cached"}
    assert "CUDA graphs need a CUDA device" in found["left_out"]["graph"]
    assert found["splats"] == {"scene": 200, "human": 100, "object": 50}
    assert found["drawn_in_the_middle"] > 100
    for row in found["ways"].values():
        assert 0 < row["deform_ms"] < row["total_ms"]
        assert row["fps"] > 0


def test_train_speed(tmp_path: Path) -> None:
    found = report("train_speed", tmp_path / "speed.json", "--steps", "2", "--warmup", "1")
    assert found["step_ms"] > 0 and len(found["blocks_ms"]) == 2
    parts = {"frame", "deform", "raster", "loss", "backward", "guard", "optimiser", "density"}
    assert parts <= set(found["host_ms"]) and parts <= set(found["waited_ms"])
    assert all(found["waited_ms"][part] > 0 for part in parts)
    assert found["graphs"]["mode"] == "plain" and "CUDA" in found["graphs"]["why"]
    assert 500 < found["operations"] < 1700  # it was 2422 before launches were counted


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a git checkout")
@pytest.mark.slow
def test_against_commit(tmp_path: Path) -> None:
    out = tmp_path / "against.json"
    clip = "builtin:lift-and-swing?width=64&frames=8&samples=1&held_out_views=0&test_frames=2"
    points = [f"model.{name}.points=60" for name in ("scene", "human", "object")]
    command = [sys.executable, "benchmarks/against_commit.py", "--commit", "HEAD", "--clip", clip,
               "--rounds", "2", "--warmup", "1", "--threads", "1", "--json", str(out),
               "--set", *points]  # fmt: skip
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert found["commit"] == found["tree"] and found["splats"]["human"] == 60
    assert set(found["measured"]) == {"step", "human", "forward", "pose", "frame"}
    for kinds in found["measured"].values():
        for row in kinds.values():
            assert row["commit_ms"] > 0 and row["tree_ms"] > 0 and 0.1 < row["ratio"] < 10
    trees = ["git", "worktree", "list"]
    listed = subprocess.run(trees, cwd=ROOT, capture_output=True, text=True, check=True)
    assert str(tmp_path) not in listed.stdout, "the checkout is still there"
