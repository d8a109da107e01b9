"""benchmarks/prepare_alone.py: its figures on known cases, without MediaPipe."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import prepare_alone

COUNT, H, W = 20, 24, 32


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Supplied files: a person on the left, and a ball of radius 4 in their mask."""
    person = np.zeros((H, W), bool)
    person[:, :16] = True
    for i in range(COUNT):
        file = tmp_path / f"hoi_mask/{i:05d}.png"
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(person | prepare_alone.disc((H, W), np.array((20, 12, 4)))).save(file)
    return tmp_path


def found_person(mask: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(masks=SimpleNamespace(human=[mask] * COUNT))


def test_the_ball_is_compared_alone_and_the_person_without_it(source: Path) -> None:
    balls = np.tile((20.0, 12.0, 4.0), (COUNT, 1))
    balls[3] = np.nan  # not known in this frame
    np.savez(source / "ball_track.npz", xyr=balls)
    ball = prepare_alone.disc((H, W), balls[0])
    half = np.zeros((H, W), bool)
    half[:, :8] = True
    row = prepare_alone.person_against(found_person(half), source)
    assert 0.43 < row["person_iou_worst_5_percent"] <= row["person_iou"] < 0.55
    lost = [ball] * (COUNT - 1) + [ball & False]
    row = prepare_alone.object_against(found_person(half), SimpleNamespace(masks=lost), source)
    assert row["object_iou"] == pytest.approx(18 / 19, abs=1e-3)
    assert row["object_iou_worst_5_percent"] == 0


def test_without_a_track_person_and_object_are_compared_together(source: Path) -> None:
    ball = prepare_alone.disc((H, W), np.array((20, 12, 4)))
    person = np.zeros((H, W), bool)
    person[:, :16] = True
    found = SimpleNamespace(masks=[ball] * COUNT, further={}, notes=[])
    row = prepare_alone.object_against(found_person(person), found, source)
    assert row["person_and_object_iou"] == 1 and str(row["object_iou"]).startswith("not computed")
    row |= prepare_alone.objects_found(found, ["4,2"])
    assert row["frames_without"] == {"object": 0}
    line = prepare_alone.table({"a, click": row | {"seconds": 9.4, "processor_seconds": 8.0}})
    assert line.splitlines()[-1] == "| a, click | - | - | 1.00, 1.00 | 0 | - | 9, 8 | - | - |"
