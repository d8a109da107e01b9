"""What makes an object's track doubtful is said."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.explained import silhouette_ious
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.make_object import doubts
from hoigs.preparation.objects.shape import sphere_points

FRAMES, WIDTH, HEIGHT = 6, 80, 60


def boxes(*corners: tuple[int, int]) -> MaskStack:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for x, y in corners:
        mask[y : y + 12, x : x + 12] = True
    return MaskStack([mask] * FRAMES)


def marks(x: float) -> torch.Tensor:
    """Landmarks around a pixel."""
    found = torch.full((FRAMES, 33, 3), torch.nan)
    found[:, :20] = torch.tensor([x, 26.0, 0.9])
    return found


def test_a_clear_object_raises_no_doubt() -> None:
    assert doubts(boxes((20, 20)), marks(60)) == []


def test_a_plate_before_somebody_is_not_taken_for_them() -> None:
    """Most landmarks lie on it, and about as much of the person is seen around it."""
    plate, around, hair = boxes((20, 20)), boxes((8, 20)), MaskStack()
    for mask in boxes((8, 20)):
        hair.append(mask & (np.arange(HEIGHT) < 24)[:, None])
    assert doubts(plate, marks(26), around) == []
    assert len(doubts(plate, marks(26), hair)) == 1


@pytest.mark.parametrize(
    ("corners", "x", "said"),
    [
        ([(72, 20)], 10, "border of the image cuts the object in 100 %"),
        ([(10, 20), (50, 20)], 70, "two large parts in 100 %"),
        ([(20, 20)], 26, "100 % of the person's landmarks lie on the object"),
    ],
)
def test_doubts(corners: list[tuple[int, int]], x: float, said: str) -> None:
    (found,) = doubts(boxes(*corners), marks(x))
    assert said in found


def test_a_rod_has_two_parts_beside_the_hand() -> None:
    assert doubts(boxes((10, 20), (50, 20)), marks(70), rod=True) == []


def test_iou_of_a_ball_and_its_mask() -> None:
    K = torch.tensor([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    camera = Camera(K, torch.eye(4), WIDTH, HEIGHT)
    disc = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] + 0.5 - np.array([30, 40])[:, None, None])) < 10
    points = sphere_points(1500, 0.2)
    places = torch.tensor([[0.0, 0, 2], [0.1, 0, 2], [0, 0, 2]])
    track = ObjectTrack(
        points, points * 0, torch.eye(3).expand(3, 3, 3), places,
        torch.tensor([True, True, False]), "",
    )  # fmt: skip
    nobody = MaskStack([np.zeros_like(disc)] * 3)
    filmed = Filmed(
        MaskStack([disc] * 3), nobody, nobody, [camera] * 3, lambda: iter(()), 25.0, None, ()
    )
    ious = silhouette_ious(track, filmed)
    assert ious[0] > 0.87 and 0.4 < ious[1] < 0.65 and np.isnan(ious[2])
