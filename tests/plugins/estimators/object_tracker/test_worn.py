"""What is proposed and covers a torso is clothes, and what has the colours of skin a limb; and
masks that take in the hands that hold a thing are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from disc_world import texture
from test_behind import footage_of

from hoigs.plugins.estimators.object_tracker.footage import bins_of, histogram
from hoigs.plugins.estimators.object_tracker.states import (
    covers_torso,
    is_worn,
    looks_like_skin,
    takes_in_hands,
)

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


@pytest.mark.parametrize(("color", "skin"), [((205, 150, 125), True), ((150, 110, 60), False)])
def test_a_bare_leg_is_told_from_a_thing_by_face_and_hands(
    color: tuple[int, int, int], skin: bool
) -> None:
    frame = texture(0, (90, 110, 150), (SIDE, SIDE))
    leg, marks = box(60, 70, 90, 110), someone()
    marks[:, (0, 15, 16)] = ((60, 20, 0, 1), (100, 60, 0, 1), (20, 60, 0, 1))
    y, x = np.mgrid[:SIDE, :SIDE]
    for at in marks[0, (0, 15, 16), :2]:
        near = np.hypot(x - at[0], y - at[1]) < 6
        frame[near] = texture(1, (205, 150, 125), (SIDE, SIDE))[near]
    frame[leg[0]] = texture(2, color, (SIDE, SIDE))[leg[0]]
    person = np.ones((SIDE, SIDE), bool)
    seen = footage_of([frame.astype(np.uint8)] * FRAMES, [person] * FRAMES)
    assert looks_like_skin(seen, leg, [marks]) == skin
    marks[..., 3] = 0  # nobody's face or hands are seen
    assert not looks_like_skin(seen, leg, [marks])


@pytest.mark.parametrize("with_hand", [True, False])
def test_masks_with_the_hand_that_holds_the_object_are_told(with_hand: bool) -> None:
    skin, green, marks = (205, 150, 125), (60, 140, 80), someone()
    frame = texture(0, (90, 110, 150), (SIDE, SIDE))
    for k, at in {16: (96, 60), 18: (100, 64), 20: (104, 62), 22: (102, 58)}.items():
        marks[:, k] = (*at, 0, 1)
    arm, thing = box(84, 50, 108, 70)[0], box(104, 52, 118, 68)[0]
    for region, color in ((arm, skin), (thing, green)):
        frame[region] = texture(2, color, (SIDE, SIDE))[region]
    seen = footage_of([frame.astype(np.uint8)] * FRAMES, [np.ones((SIDE, SIDE), bool)] * FRAMES)
    skin_bins = bins_of(seen.colors(0))[arm & ~thing]
    footage = replace(seen, limbs=histogram(skin_bins, np.ones(len(skin_bins))))
    mask = (thing | arm) if with_hand else thing
    assert takes_in_hands(footage, np.stack([mask] * FRAMES), [marks]) == with_hand
    assert not takes_in_hands(seen, np.stack([mask] * FRAMES), [marks])  # limbs are not known
