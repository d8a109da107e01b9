"""What no frame shows continues the patterns of the rest."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.preparation.completion import completed


def room(height: int = 96, width: int = 128) -> np.ndarray:
    """Vertical stripes above a floor of another colour, with a little noise."""
    x = np.arange(width)
    stripes = np.where(x % 16 < 8, 200, 60)[None, :, None].repeat(height, 0).repeat(3, 2)
    floor = np.array([120, 60, 20])
    image = np.where(np.arange(height)[:, None, None] < 64, stripes, floor)
    noise = np.random.default_rng(1).integers(-4, 5, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8)


def error(image: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    return float(np.abs(image[where].astype(float) - truth[where]).mean())


def test_edges_and_patterns_go_on_behind_whoever_stood_there() -> None:
    truth, known = room(), np.ones((96, 128), dtype=bool)
    known[30:80, 48:80] = False
    image = np.where(known[..., None], truth, 255).astype(np.uint8)
    found = completed(image, known)
    np.testing.assert_array_equal(found[known], truth[known])
    assert error(found, truth, ~known) < 8  # the nearest known pixel: 44
    np.testing.assert_array_equal(completed(image, known), found)


def test_nothing_is_taken_from_what_a_mask_leaves_out_of_somebody() -> None:
    truth, known = room(), np.ones((96, 128), dtype=bool)
    known[20:84, 40:90] = False
    spoilt = truth.copy()
    spoilt[40:52, 60:72] = (0, 255, 0)
    known[40:52, 60:72] = True
    found = completed(spoilt, known)
    green = (found[..., 1] > 150) & (found[..., 0] < 60) & ~known
    assert not green.any()
    np.testing.assert_array_equal(found[known], spoilt[known])


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_nothing_or_everything_known_stays_as_it_is(share: float) -> None:
    image = room()
    np.testing.assert_array_equal(completed(image, np.full((96, 128), bool(share))), image)


def test_a_picture_without_a_whole_patch_copies_what_is_nearest() -> None:
    image, known = room(20, 24), np.zeros((20, 24), dtype=bool)
    known[:, :3] = True
    found = completed(image, known)
    np.testing.assert_array_equal(found[:, 20], image[:, 2])
