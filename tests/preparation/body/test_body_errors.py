"""What is said of a body's errors: the frame rate does not change it, poor landmarks do."""

from __future__ import annotations

import pytest
import torch
from test_body_fit import FRAMES, QUICK, body, camera, seen_by, truth

from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.fitted import BodyErrors
from hoigs.preparation.body.landmarks import Landmarks

SECONDS = 0.2  # between frames


def said(landmarks: Landmarks, times: torch.Tensor) -> BodyErrors:
    seen = Observations(landmarks, [camera()] * len(times), times=times)
    return fit_body(body(), seen, options=QUICK).errors


def test_frames_in_between_do_not_narrow_the_limits() -> None:
    landmarks = seen_by([camera()] * FRAMES, truth())
    few = said(landmarks, SECONDS * torch.arange(FRAMES))
    rows = torch.arange(FRAMES).repeat_interleave(4)
    many = said(landmarks.rows(rows), SECONDS / 4 * torch.arange(len(rows)))
    for a, b in ((few.joints, many.joints), (few.distance, many.distance)):
        assert float(b.median()) == pytest.approx(float(a.median()), rel=0.25)


def test_landmarks_that_do_not_fit_widen_them() -> None:
    landmarks, times = seen_by([camera()] * FRAMES, truth()), SECONDS * torch.arange(FRAMES)
    image = landmarks.image.clone()
    generator = torch.Generator().manual_seed(0)
    image[..., :2] += 6 * torch.randn(image[..., :2].shape, generator=generator)
    poor = said(Landmarks(image, landmarks.world), times)
    usual = said(landmarks, times)
    for a, b in ((usual.joints, poor.joints), (usual.distance, poor.distance)):
        assert float(b.median()) > 1.15 * float(a.median())
