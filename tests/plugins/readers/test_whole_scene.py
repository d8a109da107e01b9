"""Layouts without poses serve specs of the whole picture; others get one clear message."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from layouts import colmap, dnerf, hypernerf

from hoigs.core.values.clip import Clip


@pytest.mark.parametrize("layout", [dnerf, hypernerf])
def test_4dgs_trains(builtin: Clip, tmp_path: Path, hoigs: Callable, layout: object) -> None:
    layout.write(builtin, tmp_path / "data")  # type: ignore[attr-defined]
    small = ["model.scene.deformation.resolution=16", "model.scene.deformation.time_resolution=8"]
    settings = [part for value in ("train.steps=5", *small) for part in ("--set", value)]
    result = hoigs(
        "train",
        tmp_path / "data",
        "--spec",
        "4dgs",
        *settings,
        "--out",
        tmp_path / "run",
        "--no-eval",
    )
    assert result.code == 0, result.err
    last = json.loads((tmp_path / "run/metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 5 and math.isfinite(last["psnr"]["test"])


@pytest.mark.parametrize(
    ("layout", "told"),
    [
        (dnerf, "hoigs models human and object, and clip data has no entity but the scene"),
        (hypernerf, "hoigs models human and object, and clip data has no entity but the scene"),
        (colmap, "clip data has no body poses of human: a COLMAP folder holds none"),
    ],
)
def test_hoigs_wants_people_and_things(
    builtin: Clip, tmp_path: Path, hoigs: Callable, layout: object, told: str
) -> None:
    layout.write(builtin, tmp_path / "data")  # type: ignore[attr-defined]
    result = hoigs("train", tmp_path / "data", "--spec", "hoigs", "--out", tmp_path / "run")
    assert result.code == 2 and told in result.err and "--spec 4dgs" in result.err
    assert len(result.err.strip().splitlines()) == 1, "one message"
    assert not (tmp_path / "run").exists()
