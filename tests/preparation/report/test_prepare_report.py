"""The report gives every number in JSON and in words."""

from __future__ import annotations

import json
from pathlib import Path

from hoigs.preparation.report.report import PrepareReport


def report() -> PrepareReport:
    return PrepareReport(
        name="mine", video="video.mp4", frames=40, width=96, height=64, fps=12.0, camera="static",
        parallax_degrees=0.0, coverage={"human": [0.2] * 40, "object": [0.0] * 10 + [0.05] * 30},
        body_residual_px=3.25, scene_scale=1.0, object_scale_spread=0.021, object_observed=0.75,
        scene_points=1234, provenance={"cameras": "assumed"}, warnings=["beware of the dog"],
        seconds={"frames": 0.5, "people": 20.0},
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
    assert ("time", "20 s", "frames 0.5, people 20.0") in report().rows()
