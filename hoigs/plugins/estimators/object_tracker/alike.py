"""Objects that look alike: what two tracks claim belongs to the one whose way leads there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage
from hoigs.plugins.estimators.object_tracker.path import center_of
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, overlap
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import Scene
from hoigs.plugins.estimators.object_tracker.tracker import followed

SAME = 0.5  # intersection over union from which two masks are of one thing


def told_apart(
    footage: Footage,
    scene: Scene,
    prompts: dict[str, list[PromptedMask]],
    tracks: dict[str, Track | None],
) -> tuple[dict[str, Track | None], list[str]]:
    """Tracks of which no two claim one thing, and a note for each two that did.

    The one that does not come from there is followed again with the other's pixels closed to it;
    where it still claims them, it is not seen.
    """
    found, notes = dict(tracks), []
    for a, b in combinations(tracks, 2):
        first, second = found[a], found[b]
        if first is None or second is None or not prompts[a] or not prompts[b]:
            continue
        runs = _runs(_claimed_twice(first, second))
        if not runs:
            continue
        owners = [_comes_from_there(first, second, run) for run in runs]
        for name, mine, theirs in ((a, True, second), (b, False, first)):
            lost = [i for run, owner in zip(runs, owners) if owner is not mine for i in run]
            if lost:
                found[name] = _without(footage, scene, prompts[name], theirs, lost)
        frames = [footage.numbers[i] for run in runs for i in run]
        notes.append(
            f"{a} and {b} look alike: both were found in one place in {len(frames)} frames "
            f"({frames[0]} to {frames[-1]}), and told apart by where they came from; look at them "
            "there, and click where they are wrong"
        )
    return found, notes


def _claimed_twice(a: Track, b: Track) -> Bool[np.ndarray, " F"]:
    pairs = zip(a.soft > 127, b.soft > 127, strict=True)
    return np.array([bool((x & y).any()) and overlap(x, y) > SAME for x, y in pairs])


def _runs(frames: Bool[np.ndarray, " F"]) -> list[range]:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], frames, [0])).astype(int)))
    return [range(start, end) for start, end in edges.reshape(-1, 2).tolist()]


def _comes_from_there(a: Track, b: Track, run: range) -> bool:
    """Whether the place that both claim is nearer to where `a` was before, or is after."""
    return min(_jumps(a, run)) <= min(_jumps(b, run))


def _jumps(track: Track, run: range) -> list[float]:
    """Pixels a frame to the nearest sightings outside of the run, before and after it."""
    seen = [i for i, soft in enumerate(track.soft) if (soft > 127).any()]
    before = [(i, run.start) for i in seen if i < run.start][-1:]
    after = [(i, run.stop - 1) for i in seen if i >= run.stop][:1]
    ways = [(_center(track, i) - _center(track, edge), abs(i - edge)) for i, edge in before + after]
    return [np.inf, *(float(np.hypot(*way)) / frames for way, frames in ways)]


def _center(track: Track, i: int) -> Float[np.ndarray, "2"]:
    return np.array(center_of(track.soft[i] > 127))


def _without(
    footage: Footage,
    scene: Scene,
    prompts: Sequence[PromptedMask],
    other: Track,
    frames: Sequence[int],
) -> Track:
    """Followed again with another object's pixels closed in some frames."""
    closed = footage.blank.copy()
    for i in frames:
        closed[i] |= ndimage.binary_dilation(other.soft[i] > 127, iterations=3)
    for p in prompts:  # which are right even there
        closed[p.frame] &= ~(p.soft > 0.5)
    again = followed(replace(footage, blank=closed), scene, prompts)
    soft, confidence = again.soft.copy(), again.confidence.copy()
    for i in np.flatnonzero(_claimed_twice(again, other)).tolist():
        if i not in {p.frame for p in prompts}:  # where the other was before
            soft[i], confidence[i] = 0, 0.0
    return Track(soft, confidence)
