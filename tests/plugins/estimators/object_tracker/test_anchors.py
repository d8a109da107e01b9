"""The second pass of estimator:object-tracker, from the frames that the first found best."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from test_behind import footage_of, seated

from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, overlap
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import static_scene
from hoigs.plugins.estimators.object_tracker.tracker import _joined, anchors, tracked

CLICKED, SPOILT = 0, range(10, 15)


def soft(masks: np.ndarray) -> np.ndarray:
    return np.uint8(255) * masks


def spoilt_track():
    """Footage, true masks, and a track that takes in too much in some frames and misses one."""
    frames, people, (discs,) = seated()
    masks = discs.copy()
    for i in SPOILT:
        masks[i] = ndimage.binary_dilation(masks[i], iterations=6)
    masks[30] = False
    return footage_of(frames, people), discs, Track(soft(masks), np.ones(len(masks)))


def prompt(i: int, mask: np.ndarray) -> PromptedMask:
    return PromptedMask(i, mask.astype(np.float32), 1.0, False, np.zeros_like(mask))


def test_anchors_are_whole_masks_apart_from_each_other_and_from_the_click() -> None:
    footage, discs, track = spoilt_track()
    found = anchors(footage, track, [prompt(CLICKED, discs[CLICKED])])
    frames = sorted([CLICKED, *(p.frame for p in found)])
    assert len(found) >= 3 and min(np.diff(frames)) >= len(footage) / 8
    assert not {*SPOILT, 30} & {*frames}
    assert all(overlap(p.soft > 0.5, discs[p.frame]) == 1 for p in found)


def test_from_anchors_a_thing_is_found_where_one_click_misses_it() -> None:
    """The clicked mask is the disc's left half; an anchor shows the whole of it."""
    footage, discs, _ = spoilt_track()
    x = np.nonzero(discs[CLICKED])[1]
    part = discs[CLICKED] & (np.arange(discs.shape[2]) < x.mean())
    scene, clicked = static_scene(footage), [prompt(CLICKED, part)]
    best = [prompt(i, discs[i]) for i in (8, 18, 28, 38)]
    score = [
        np.mean([overlap(m > 127, d) for m, d in zip(track.soft, discs, strict=True)])
        for track in (tracked(footage, scene, clicked), tracked(footage, scene, clicked, best))
    ]
    assert score[1] > score[0] + 0.1


def test_where_both_passes_agree_the_first_stays_and_elsewhere_the_surer_counts() -> None:
    _, discs, first = spoilt_track()
    nearly = np.stack([ndimage.binary_erosion(d) for d in discs])
    differs = [*SPOILT, 30]
    first.confidence[differs] = 0.4
    joined = _joined(first, Track(soft(nearly), np.full(len(discs), 0.5)))
    assert (joined.soft[differs] == soft(nearly)[differs]).all()
    assert (joined.confidence[differs] == 0.5).all()
    same = np.setdiff1d(np.arange(len(discs)), differs)
    assert (joined.soft[same] == first.soft[same]).all() and (joined.confidence[same] == 1).all()
