"""benchmarks/estimated.py: its smallest size, and its figures on known cases."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import estimated
from estimates import figures


def test_figures_of_the_smallest_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = [
        "estimated.py", "lift-and-swing", "--width", "64", "--frames", "8",
        "--variant", "short:fit_steps=20", "--train", "2",
        "--pictures", str(tmp_path), "--json", str(tmp_path / "rows.json"),
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", arguments)
    assert estimated.main() == 0
    (row,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert row["frames"] == 8 and row["variant"] == "short"
    assert 0 < row["place_mm"]["mean"] < 1000
    assert 0 < row["root_aligned_joints_mm"] < 200
    assert 0.5 < row["size_ratio"] < 2
    for trained in ("estimated", "every_pose_given"):
        scores = row[trained]["interpolated poses"]
        assert all(5 < s["human_object"] < 40 for s in scores.values()) and len(scores) == 2
    assert len(list(tmp_path.glob("*.png"))) == 2


def test_chamfer_finds_the_turn_and_names_the_size() -> None:
    rng = np.random.default_rng(0)
    box = (rng.random((4000, 3)) - 0.5) * (0.3, 0.2, 0.1)
    turned = box @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], float).T + 0.4
    distance, size = figures.chamfer(1.1 * turned, box)
    assert distance < 0.01 and size == pytest.approx(1.1, abs=1e-6)


def test_mean_rotation_is_the_constant_between_two_tracks() -> None:
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], float)
    assert np.allclose(figures.angles(figures.mean_rotation(turn[None]), turn), 0)
    assert np.allclose(figures.angles(turn, np.eye(3)), 90)
