"""The report names parts of the body that are out of view."""

from __future__ import annotations

import torch

from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.people import _unseen, unseen_parts


def said(image: torch.Tensor) -> list[str]:
    landmarks = Landmarks(image, image)
    return _unseen(unseen_parts(landmarks), landmarks)


def test_parts_out_of_view_are_named() -> None:
    image = torch.ones(10, 33, 3)
    assert said(image) == []
    image[1:, 25:, 2] = 0.1  # one frame in ten shows a leg
    [sentence] = said(image)
    assert sentence.startswith("the person's legs are out of view")


def test_a_person_in_few_frames_and_without_a_head_is_doubted() -> None:
    image = torch.full((20, 33, 3), 0.9)
    image[4:] = float("nan")
    assert said(image) == []  # of few frames, but with a head
    image[:4, 0:11, 2] = 0.1
    doubt, _ = said(image)
    assert "is it one?" in doubt
    whole = image[:4]
    assert len(said(whole)) == 1
