"""What is proposed and covers a torso is clothes; what is held before one is not."""

from __future__ import annotations

import numpy as np

from hoigs.plugins.estimators.object_tracker.states import covers_torso, is_worn

FRAMES, SIDE = 8, 120


def someone() -> np.ndarray:
    """Landmarks of a person who faces the camera with raised upper arms."""
    marks = np.zeros((FRAMES, 33, 4))
    marks[..., :2] = -500
    for k, at in {
        11: (80, 30), 12: (40, 30), 23: (72, 80), 24: (48, 80), 13: (112, 40), 14: (8, 40),
        25: (72, 115), 26: (48, 115),
    }.items():  # fmt: skip
        marks[:, k] = (*at, 0, 1)
    return marks


def box(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    masks = np.zeros((FRAMES, SIDE, SIDE), bool)
    masks[:, top:bottom, left:right] = True
    return masks


def test_a_shirt_with_sleeves_is_clothes() -> None:
    shirt = box(42, 26, 78, 84) | box(14, 26, 42, 46) | box(78, 26, 106, 46)
    assert covers_torso(shirt, [someone()])
    assert not is_worn(shirt, [someone()])  # sleeves leave the torso


def test_what_is_held_before_the_torso_is_no_shirt() -> None:
    small, wide = box(52, 60, 66, 74), box(2, 40, 118, 80)
    assert not covers_torso(small, [someone()])
    assert not covers_torso(wide, [someone()])


def test_a_torso_that_is_not_seen_says_nothing() -> None:
    hidden = someone()
    hidden[:, 23:25, 3] = 0
    assert not covers_torso(box(42, 26, 78, 84), [hidden])
