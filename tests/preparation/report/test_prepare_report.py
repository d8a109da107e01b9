"""The report gives every number in JSON and in words; stages add up to one progress."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hoigs.preparation.report.report import PrepareReport
from hoigs.preparation.stages import Stages


def report() -> PrepareReport:
    return PrepareReport(
        name="mine", video="video.mp4", frames=40, width=96, height=64, fps=12.0, camera="static",
        parallax_degrees=0.0, coverage={"human": [0.2] * 40, "object": [0.0] * 10 + [0.05] * 30},
        body_residual_px=3.25, scene_scale=1.0, object_scale_spread=0.021, object_observed=0.75,
        scene_points=1234, provenance={"cameras": "assumed"}, warnings=["beware of the dog"],
        seconds={"frames": 0.5, "body": 20.0},
    )  # fmt: skip


def test_files(tmp_path: Path) -> None:
    report().save(tmp_path)
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert numbers["body_residual_px"] == 3.25 and len(numbers["coverage"]["object"]) == 40
    text = (tmp_path / "report.md").read_text()
    for part in ("# mine", "3.2 px", "75 %", "beware of the dog", "empty in 10 frames", "2.1 %"):
        assert part in text
    assert "| mask of object | 3.8 % | of the image," in text


def test_rows_have_three_cells() -> None:
    assert all(len(row) == 3 for row in report().rows())
    assert ("time", "20 s", "frames 0.5, body 20.0") in report().rows()


def test_progress_runs_from_0_to_1() -> None:
    seen: list[tuple[float, str]] = []
    stages = Stages({"a": 1, "b": 3}, lambda done, text: seen.append((done, text)))
    with stages.stage("a"):
        assert list(stages.track("xy", 2)) == ["x", "y"]
    with stages.stage("b"):
        stages.advance(0.5)
    values = [done for done, _ in seen]
    assert values == sorted(values) and values[0] == 0 and values[-1] == pytest.approx(1)
    assert (0.625, "b") in seen and set(stages.seconds) == {"a", "b"}
