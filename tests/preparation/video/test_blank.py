"""Patches without a picture are distinguished from dark objects."""

from __future__ import annotations

import numpy as np

from hoigs.preparation.final_masks import blank_pixels


def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(40, 200, (80, 100, 3), dtype=np.uint8)


NOTHING = np.zeros((80, 100), dtype=bool)


def test_a_painted_patch_is_found_with_the_rim_that_the_codec_mixed() -> None:
    image = picture()
    image[:20, 30:70] = 0
    image[20, 30:70] = 12
    blank = blank_pixels(image, NOTHING)
    assert blank[:21, 30:70].all()
    assert blank.sum() <= 23 * 44


def test_dark_but_not_flat_black_is_part_of_the_scene() -> None:
    image = picture()
    image[40:60, 40:60] = np.random.default_rng(1).integers(3, 20, (20, 20, 3))
    assert not blank_pixels(image, NOTHING).any()


def test_single_black_pixels_and_black_clothes_are_no_blank() -> None:
    image = picture()
    image[5, 5] = 0
    image[50:70, 10:30] = 0
    moving = NOTHING.copy()
    moving[48:72, 8:32] = True
    assert not blank_pixels(image, moving).any()
