"""benchmarks/end_to_end.py: its figures on known cases (MediaPipe, which it needs, is not run)."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import end_to_end
from estimates.source import landmarks

from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin_clip


def test_landmarks_a_pixel_off_are_a_pixel_off() -> None:
    body = AnnyBody()
    truth = ClipFolderReader().read(builtin_clip(body, SceneConfig.tiny()))
    image = landmarks(truth, body, (0.0, 0.0), 0)["image_xyzv"]
    image[..., 0] += 1
    image[0] = np.nan
    row = end_to_end.landmark_figures(image, truth, body)
    assert row["frames_with_landmarks"] == len(truth) - 1
    assert row["landmarks_px"]["median"] == pytest.approx(1, abs=1e-3)
    assert end_to_end.scale_ratio(truth, truth) == 1


def test_overlaps_count_empty_masks_and_leave_out_frames_without_the_thing() -> None:
    full, half = torch.ones(4, 4, dtype=torch.bool), torch.zeros(4, 4, dtype=torch.bool)
    half[:2] = True
    truth = [SimpleNamespace(masks={"object": m}) for m in (full, full, full & ~full)]
    found = end_to_end.overlaps([half, full & ~full, full], truth, "object")
    assert found == {"mean": 0.25, "worst": 0.0, "empty": 1}
    line = end_to_end.table({"a, click": {"object_iou": found}}).splitlines()[-1]
    assert "| 0.25, 0.0 | 1 |" in line
