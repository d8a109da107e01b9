"""Thin things that looks do not prove, found by what nothing explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from disc_world import H, W, texture
from test_behind import footage_of

from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, overlap
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import is_static, static_scene
from hoigs.plugins.estimators.object_tracker.unexplained import completed

COUNT, CLICKED = 24, 3


def swung(rods: int = 1):
    """A rod that turns about a hand, beside a ball; and further rods, one for each other hand."""
    wall = texture(0, (120, 130, 90))[:, :W]
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:H, :W] + 0.5
    person = np.abs(x - 50) < 6
    frames, masks = [], []
    for i in range(COUNT):
        image = wall + rng.normal(size=wall.shape)
        image[person] = (70, 80, 150)
        image[np.hypot(x - 92, y - 8 - 2 * i) < 5] = (230, 230, 235)
        found = []
        for k in range(rods):
            along = np.array((np.cos(1.2 - 0.12 * i), np.sin(1.2 - 0.12 * i)))
            from_hand = np.stack((x - 57, y - 36 + 14 * k), -1)
            share, off = from_hand @ along, from_hand @ (-along[1], along[0])
            rod = (share > 0) & (share < 26) & (np.abs(off) < 1.2)
            image[rod] = (40, 40, 50)
            found.append(rod)
        frames.append(image.clip(0, 255).astype(np.uint8))
        masks.append(found)
    return frames, [person] * COUNT, [np.stack(m) for m in zip(*masks, strict=True)]


def clicked_alone(masks: np.ndarray) -> tuple[PromptedMask, Track]:
    """A rod that is known in the clicked frame, and in no other."""
    soft = np.zeros(masks.shape, np.uint8)
    soft[CLICKED] = 255 * masks[CLICKED]
    prompt = PromptedMask(
        CLICKED, masks[CLICKED].astype(np.float32), 1.0, False, np.zeros((H, W), bool)
    )
    return prompt, Track(soft, (np.arange(COUNT) == CLICKED) * 1.0)


def test_a_swung_rod_is_found_by_what_neither_scene_nor_body_explains() -> None:
    frames, people, (rod,) = swung()
    footage = footage_of(frames, people)
    prompt, track = clicked_alone(rod)
    found = completed(footage, static_scene(footage), [prompt], track)
    overlaps = [overlap(a > 127, b) for a, b in zip(found.soft, rod, strict=True)]
    assert np.mean(np.array(overlaps) > 0.5) > 0.8
    wrong = [(a > 127)[~b].sum() > b.sum() for a, b in zip(found.soft, rod, strict=True)]
    assert not any(wrong)
    assert (track.soft[CLICKED + 1] == 0).all()  # what was given stays as it was


def test_of_two_rods_that_may_be_it_none_is_taken() -> None:
    frames, people, (rod, other) = swung(rods=2)
    footage = footage_of(frames, people)
    prompt, track = clicked_alone(rod)
    found = completed(footage, static_scene(footage), [prompt], track)
    for mask, theirs in zip(found.soft > 127, other, strict=True):
        assert not (mask & theirs).sum() > 0.5 * mask.sum() or not mask.any()


def test_a_letterbox_is_no_border_of_a_stabilised_video() -> None:
    frames, people, _ = swung()
    footage = footage_of(frames, people)
    bars = np.zeros_like(footage.blank)
    bars[:, :6] = True
    assert is_static(footage) and is_static(replace(footage, blank=bars))
    bars[COUNT // 2 :] = False
    assert not is_static(replace(footage, blank=bars))
    dark = footage.lab.copy()  # a wall that is nearly black, and black in some frames
    dark[:, :6] = 4, 128, 128
    assert is_static(replace(footage, blank=bars, lab=dark))
