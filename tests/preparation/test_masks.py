"""Masks come in at the frames' size, are kept as bits, and lose their crumbs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny import FRAMES, HEIGHT, WIDTH, masks

from hoigs.core.undistortion import Undistortion
from hoigs.preparation.frames import VideoFrames
from hoigs.preparation.masks import MaskStack, largest_parts, load_masks
from hoigs.preparation.source import SourceError


def test_masks_are_read_by_video_frame_number(tiny_source: Path) -> None:
    video = VideoFrames(tiny_source / "video.mp4", every=4)
    stack = load_masks(tiny_source / "hoi_mask", video, Undistortion())
    assert len(stack) == 3
    for frame, mask in zip((0, 4, 8), stack, strict=True):
        np.testing.assert_array_equal(mask, np.logical_or(*masks(frame)))
    expected = np.logical_or(*masks(4)).mean()
    assert stack.coverage()[1] == pytest.approx(expected)


def test_masks_follow_the_width(tiny_source: Path) -> None:
    video = VideoFrames(tiny_source / "video.mp4", width=WIDTH // 2)
    stack = load_masks(tiny_source / "hoi_mask", video, Undistortion())
    assert stack[0].shape == (HEIGHT // 2, WIDTH // 2)
    assert stack[0].mean() == pytest.approx(np.logical_or(*masks(0)).mean(), abs=0.01)


def test_odd_widths_survive_the_packing() -> None:
    mask = np.random.default_rng(0).random((5, 13)) > 0.5
    np.testing.assert_array_equal(MaskStack([~mask, mask])[1], mask)


def test_absent_and_wrong_masks_are_named(tiny_source: Path) -> None:
    video = VideoFrames(tiny_source / "video.mp4")
    Image.new("L", (WIDTH, HEIGHT // 2)).save(tiny_source / "hoi_mask/00003.png")
    with pytest.raises(SourceError, match=r"00003\.png is 96x32, another shape"):
        load_masks(tiny_source / "hoi_mask", video, Undistortion())
    for i in (3, FRAMES - 1):
        (tiny_source / f"hoi_mask/{i:05d}.png").unlink()
    with pytest.raises(SourceError, match=r"lacks 2 of 12 masks: 00003\.png, 00011\.png; masks"):
        load_masks(tiny_source / "hoi_mask", video, Undistortion())


def test_crumbs_go_and_limbs_stay() -> None:
    mask = np.zeros((40, 40), bool)
    mask[2:22, 2:22] = mask[30:36, 30:36] = True
    body = mask.copy()
    mask[38, 38] = True
    np.testing.assert_array_equal(largest_parts(mask), body)
    np.testing.assert_array_equal(largest_parts(~(mask | True)), np.zeros_like(mask))
