"""Where the object is in each frame: candidates of every frame, and the path of least cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.appearance import Appearance
from hoigs.plugins.estimators.object_tracker.footage import ColorModel, Footage, bins_of, histogram
from hoigs.plugins.estimators.object_tracker.scene import MovingScene, Scene, median_of

CANDIDATES = 8
ABSENT = 1.1  # cost of a frame in which the object is not seen
TURN = 0.8  # and of its going or coming back
JUMP = 8.0  # and of lying, all at once, elsewhere, as if it had been there before
BY_COLOR, BY_LOOKS = 0.4, 0.8  # weights of their log-odds
CHANGED = 4  # units of noise by which a pixel differs from the scene


@dataclass(frozen=True)
class Path:
    """Centre of the object in each frame, interpolated where it is not seen, and whether it is."""

    centers: Float[np.ndarray, "F 2"]
    seen: Bool[np.ndarray, "F"]


@dataclass(frozen=True)
class Evidence:
    """What speaks for an object anywhere in the video: its colours and looks, and the scene, which
    it is none of; None where it may be a part of that."""

    footage: Footage
    scene: Scene | None
    colors: ColorModel
    looks: Appearance


def object_odds(evidence: Evidence, i: int) -> Float[np.ndarray, "h w"]:
    """Log-odds of each pixel of a frame to be the object's, from what is known of it anywhere."""
    footage, scene = evidence.footage, evidence.scene
    odds = BY_COLOR * evidence.colors.odds(bins_of(footage.colors(i)))
    odds = odds + BY_LOOKS * evidence.looks.odds(i) - 0.7 * footage.body(i)
    if scene is not None:
        changed = np.nan_to_num(np.tanh((scene.difference(i) - 4) / 3), nan=0.0)
        odds = odds + np.maximum(changed, -0.3)  # a plain or resting thing may look unchanged
    odds[footage.blank[i]] = -6
    return odds


def found_path(
    evidence: Evidence,
    known: Mapping[int, Bool[np.ndarray, "h w"]],
    frames: Sequence[int] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """The path through the masks at `known` frames that follows what looks like the object.

    Args:
        frames: neighbours, in order of going through them; None: all. The path has as many rows.
    """
    footage, scene, colors = evidence.footage, evidence.scene, evidence.colors
    order = list(range(len(footage)) if frames is None else frames)
    size = float(np.sqrt(np.mean([m.sum() for m in known.values()]) / np.pi))
    found = []
    for row, i in enumerate(order):
        if i in known:
            places = np.array([center_of(known[i])])
            found.append((places, np.array([-4.0]), np.zeros(1, bool)))
        else:
            odds = object_odds(evidence, i)
            places, cost = _candidates(odds, bins_of(footage.colors(i)), colors, size)
            found.append((places, cost, _still(scene, i, places, size)))
        progress((row + 1) / len(order))
    return _cheapest(found, size, [row for row, i in enumerate(order) if i in known])


def _still(
    scene: Scene | None, i: int, places: Float[np.ndarray, "C 2"], size: float
) -> Bool[np.ndarray, "C"]:
    """Which places look like the scene of a moving camera's nearby frames. Before a still camera
    the scene is known better, and its odds say enough."""
    still = np.zeros(len(places), bool)
    if isinstance(scene, MovingScene):
        away, r = scene.difference(i), max(1, int(0.6 * size))
        for row, (x, y) in enumerate(places.astype(int)):
            part = away[max(y - r, 0) : y + r + 1, max(x - r, 0) : x + r + 1]
            still[row] = not median_of(part) > CHANGED
    return still


def center_of(mask: Bool[np.ndarray, "h w"]) -> tuple[float, float]:
    """The middle x, y of a mask."""
    y, x = np.nonzero(mask)
    return float(x.mean() + 0.5), float(y.mean() + 0.5)


def _candidates(
    odds: np.ndarray, bins: np.ndarray, colors: ColorModel, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Places x, y that may be the object, and their cost."""
    step = max(1, int(size / 6))
    small = odds[::step, ::step]
    p = 1 / (1 + np.exp(-small))
    r = size / step
    best = np.full(p.shape, -np.inf)
    for factor in (0.75, 1.15):
        s = r * factor / 1.5
        inner = ndimage.gaussian_filter(p, s, mode="constant", truncate=2.5)
        outer = ndimage.gaussian_filter(p, 2 * s, mode="nearest", truncate=2.5)
        response = inner - 0.6 * outer
        best = np.maximum(best, response)
    peaks = best == ndimage.maximum_filter(best, size=2 * max(1, int(0.5 * r)) + 1)
    peaks &= best > 0.08
    y, x = np.nonzero(peaks)
    order = np.argsort(-best[y, x])[:CANDIDATES]
    y, x = y[order], x[order]
    places = np.stack((x, y), -1) * float(step) + 0.5 * step
    cost = [
        1.6 - 2.6 * min(float(best[b, a]) / 0.4, 1) * _likeness(bins, colors, place, size)
        for (a, b), place in zip(zip(x, y), places)
    ]
    return places.reshape(-1, 2), np.asarray(cost, float)


def _likeness(bins: np.ndarray, colors: ColorModel, place: np.ndarray, size: float) -> float:
    r = max(1, int(0.8 * size))
    x, y = (int(v) for v in place)
    part = bins[max(y - r, 0) : y + r + 1, max(x - r, 0) : x + r + 1]
    return colors.likeness(histogram(part, np.ones(part.shape)))


def _cheapest(frames: list, size: float, known: list[int]) -> Path:
    """Viterbi's path over candidates and absence; an absence keeps the place it began at."""
    # state: row of x, y of the last sighting, its age, whether it is seen now
    spots: list[list] = []
    costs: list[list] = []
    back: list[list] = []
    for i, (places, unary, still) in enumerate(frames):
        here = [(p, 0) for p in places]
        if i == 0:
            # where it is known it is not absent, from where it could turn up anywhere
            total = [*unary, *(() if i in known else (ABSENT,))]
            state = [*here, *(() if i in known else ((None, 1),))]
            parent = [-1] * len(total)
        else:
            total, parent, state = [], [], []
            before, before_cost = spots[-1], costs[-1]
            for place, cost, lies in zip(places, unary, still):
                moves = [c + _move(s, place, size, lies) for s, c in zip(before, before_cost)]
                k = int(np.argmin(moves))
                total.append(moves[k] + cost)
                parent.append(k)
                state.append((place, 0))
            if i not in known:
                # the object is absent after each of the cheapest states before
                gone = [
                    c + ABSENT + (TURN if s[1] == 0 else 0) for s, c in zip(before, before_cost)
                ]
                for k in np.argsort(gone)[:CANDIDATES]:
                    total.append(gone[k])
                    parent.append(int(k))
                    state.append((before[k][0], before[k][1] + 1))
        spots.append(state)
        costs.append(total)
        back.append(parent)
    k = int(np.argmin(costs[-1]))
    centers = np.full((len(frames), 2), np.nan)
    for i in range(len(frames) - 1, -1, -1):
        place, age = spots[i][k]
        if age == 0:
            centers[i] = place
        k = back[i][k]
    return _interpolated(centers)


def path_of(masks: Bool[np.ndarray, "F h w"]) -> Path:
    """The way of an object whose masks are known; it is not seen where they are empty."""
    return _interpolated(np.array([center_of(m) if m.any() else (np.nan, np.nan) for m in masks]))


def _interpolated(centers: Float[np.ndarray, "F 2"]) -> Path:
    """The path through centres, NaN where it is not seen."""
    seen = np.isfinite(centers[:, 0])
    rows = np.arange(len(centers))
    for axis in range(2):
        centers[:, axis] = np.interp(rows, rows[seen], centers[seen, axis])
    return Path(centers, seen)


def _move(before: tuple, place: np.ndarray, size: float, still: bool) -> float:
    """Cost of a step: grows with its length in radii of the object, up to a jump's."""
    spot, age = before
    if spot is None:
        return TURN
    far = float(np.hypot(*(place - spot))) / size
    jump = JUMP if still and far > 1.5 else 0.0
    if age:
        return TURN + jump + min(0.25 * far / (1 + age), 3.0)
    return jump + (min(0.25 * far, 1.0) if far < 4 else min(1.0 + 0.5 * (far - 4), 5.0))
