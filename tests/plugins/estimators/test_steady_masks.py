"""Masks of a still camera agree wherever its frames do."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.plugins.estimators.steady_masks import SteadyMasks

FRAMES, H, W = 40, 90, 160
TRUNK, TABLE = np.s_[20:70, 60:100], np.s_[70:88, 20:140]


def still_video() -> tuple[np.ndarray, np.ndarray]:
    """A patterned room with a person who keeps still at a table, and their mask."""
    images = np.random.default_rng(0).integers(60, 180, (1, H, W, 3)).astype(np.uint8)
    images = np.repeat(images, FRAMES, 0)
    images[:, *TRUNK], images[:, *TABLE] = 230, 235
    masks = np.zeros((FRAMES, H, W), bool)
    masks[:, *TRUNK] = True
    return images, masks


def steadied(images: np.ndarray, masks: np.ndarray) -> tuple[bool, np.ndarray]:
    steady = SteadyMasks([masks], images, (W, H))
    return steady.still, np.stack([steady.mask(0, i) for i in range(len(masks))])


def test_a_table_that_is_taken_in_now_and_then_goes_and_a_lost_trunk_comes_back() -> None:
    images, truth = still_video()
    masks = truth.copy()
    masks[::4, *TABLE] = True
    masks[1::8, *TRUNK] = False
    still, found = steadied(images, masks)
    assert still
    wrong = (found != truth).mean((1, 2))
    assert wrong.max() < 0.01 < (masks != truth).mean((1, 2)).max()


def test_an_arm_in_front_of_its_own_colour_stays() -> None:
    images, masks = still_video()
    for i in range(FRAMES):
        arm = np.s_[72:77, 20 + 2 * i : 40 + 2 * i]  # narrow, white on white
        images[i][arm], masks[i][arm] = 236, True
    still, found = steadied(images, masks)
    assert still and (found == masks).mean() > 0.999


def test_what_looks_different_in_each_frame_is_left_alone() -> None:
    images, masks = still_video()
    for i in range(FRAMES):
        images[i][5:40, 110:150] = 6 * i  # a screen, which is no person, but for once
    masks[7, 5:40, 110:150] = True
    assert (steadied(images, masks)[1] == masks).all()


@pytest.mark.parametrize("moving", [True, False])
def test_the_camera_has_to_stand_still(moving: bool) -> None:
    images, masks = still_video()
    shown = np.stack([np.roll(im, 3 * i * moving, 1) for i, im in enumerate(images)])
    assert SteadyMasks([masks], shown, (W, H)).still != moving


def test_masks_of_another_size_keep_it() -> None:
    images, masks = still_video()
    large = images.repeat(2, 1).repeat(2, 2)
    other = np.roll(masks, 60, 2)
    steady = SteadyMasks([masks, other], large, (2 * W, 2 * H))
    assert steady.still
    for k, own in enumerate((masks, other)):
        assert steady.mask(k, 3).shape == (H, W) and (steady.mask(k, 3) == own[3]).mean() > 0.99
