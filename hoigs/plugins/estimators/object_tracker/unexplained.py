"""Things that looks do not prove, by what neither a still scene nor a body explains.

The strings of a racket show what is behind them, and the shaft of a club is two pixels wide: what
they look like changes from frame to frame. Before a still camera they are a part of what differs
from the scene and is no body, and of these parts the one of their length and colours that is where
they can have come to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage, bins_of, histogram
from hoigs.plugins.estimators.object_tracker.prompts import (
    UNEXPLAINED,
    PromptedMask,
    of_person,
    overlap,
)
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import Scene, StaticScene

WHOLE = 0.5  # intersection over union of the clicked mask and a part, from which that is the object
LIKE = 0.55  # likeness of a part to the object from which it may be it
SURE = 0.65  # and likeness from which it is it wherever it is, after a while without it
CLEAR = 0.1  # how much more like it is than any other part in reach
FEWEST = 12  # pixels of a part
LENGTHS, AREAS = (0.45, 1.3), (0.3, 2.2)  # of the object's
PIECES = 0.15  # of its length: a gap between pieces of one thing
REACH, LONGEST = 0.5, 6  # of its length a frame; frames without it after which it may be anywhere
LEARNT = 0.2  # weight of each new frame's colours
MORE = 0.15  # how much more of the person's colours a part may have than the clicked one


@dataclass(frozen=True)
class Part:
    """Connected pixels of a frame that nothing explains.

    Attributes:
        colors: of its pixels that are not beside a body. length: of its longest axis, pixels.
    """

    mask: Bool[np.ndarray, "h w"]
    colors: Float[np.ndarray, "B"]
    length: float

    @property
    def area(self) -> float:
        return float(self.mask.sum())

    def like(self, other: Part) -> float:
        """Likeness of colours, lengths and areas, 0 to 1."""
        ratios = np.array((self.length / other.length, (self.area / other.area) ** 0.5))
        return self.alike(other) * float(np.prod(np.minimum(ratios, 1 / ratios) ** 0.5))

    def alike(self, other: Part) -> float:
        """Likeness of colours (Bhattacharyya coefficient), 0 to 1."""
        return float(np.sqrt(self.colors * other.colors).sum())

    def may_be(self, other: Part) -> bool:
        """Whether it is about as long and large."""
        long, large = self.length / other.length, self.area / other.area
        return LENGTHS[0] < long < LENGTHS[1] and AREAS[0] < large < AREAS[1]

    def gaps(self, others: Sequence[Part]) -> list[float]:
        """Pixels between this one and each of the others."""
        away = ndimage.distance_transform_edt(~self.mask)
        return [float(away[other.mask].min()) for other in others]


def parts_of(footage: Footage, scene: Scene, i: int, least: float) -> list[Part]:
    """All parts of a frame that differ from the scene by `least` units of its noise."""
    body = footage.body(i)
    changed = (np.nan_to_num(scene.difference(i)) > least) & ~body
    free = changed & ~ndimage.binary_dilation(body, iterations=footage.unit)
    near = np.ones((3, 3), bool)
    labels, _ = ndimage.label(ndimage.binary_closing(changed, near), near)
    bins = bins_of(footage.colors(i))
    large = np.flatnonzero(np.bincount(labels[free], minlength=1) >= FEWEST)
    masks = [labels == k for k in large.tolist() if k]
    return [Part(m, histogram(bins, (m & free) * 1.0), length_of(m)) for m in masks]


def length_of(mask: Bool[np.ndarray, "h w"]) -> float:
    """Pixels along the longest axis, by its second moments: that of a rod is 1.15 times its own."""
    spread = np.linalg.eigvalsh(np.cov(np.stack(np.nonzero(mask))))[-1]
    return float(4 * np.sqrt(max(spread, 0.1)))


def completed(
    footage: Footage, scene: Scene, prompts: Sequence[PromptedMask], track: Track
) -> Track:
    """The track, and where it has no mask before a still camera the part that is the object."""
    missed = ~(track.soft > 127).any((1, 2))
    if not missed.any() or not isinstance(scene, StaticScene):
        return track
    track = Track(track.soft.copy(), track.confidence.copy())
    for prompt in prompts:
        others = {p.frame for p in prompts if p is not prompt}
        for step in (1, -1):
            frames = _until(prompt.frame, step, others, len(footage))
            _walk(footage, scene, prompt, frames, track)
    return track


def _until(start: int, step: int, ends: set[int], count: int) -> Iterator[int]:
    """The frames from one on, up to the first of `ends`."""
    i = start + step
    while 0 <= i < count and i not in ends:
        yield i
        i += step


def _walk(
    footage: Footage,
    scene: StaticScene,
    prompt: PromptedMask,
    frames: Iterator[int],
    track: Track,
) -> None:
    """Fills in what is missing of a track, from a prompted frame outwards."""
    found = _clicked(footage, scene, prompt)
    if found is None:
        return
    least, clicked = found
    most = MORE + of_person(footage, prompt.frame, clicked.mask)
    known, last = clicked, prompt.frame
    for i in frames:
        mask, parts, gap = track.soft[i] > 127, parts_of(footage, scene, i, least), abs(i - last)
        part: Part | None
        if mask.any():
            own = [p for p in parts if overlap(_filled(p.mask), mask) > WHOLE]
            part = own[0] if own else None
        else:
            reach = REACH * clicked.length * gap if gap <= LONGEST else np.inf
            part, like = _best(parts, clicked, known, reach)
            if part is not None and of_person(footage, i, part.mask) > most:
                part = None
            if part is not None:
                track.soft[i], track.confidence[i] = 255 * _filled(part.mask), like
        if part is not None:
            colors = (1 - LEARNT) * known.colors + LEARNT * part.colors
            known, last = replace(part, colors=colors), i


def _clicked(
    footage: Footage, scene: StaticScene, prompt: PromptedMask
) -> tuple[float, Part] | None:
    """The part that a prompted mask is, and from which difference on."""
    mask, found = prompt.soft > 0.5, []
    for least in UNEXPLAINED:
        for part in parts_of(footage, scene, prompt.frame, least):
            if (part.mask & mask).any():
                found.append((overlap(_filled(part.mask), mask), least, part))
    if not found:
        return None
    share, least, part = max(found, key=lambda f: f[0])
    return None if share < WHOLE else (least, part)


def _best(
    parts: Sequence[Part], clicked: Part, known: Part, reach: float
) -> tuple[Part | None, float]:
    """The part that is the object, and its likeness; None where none or several may be."""
    looks = replace(clicked, colors=known.colors)
    near = [p for p, gap in zip(parts, known.gaps(parts), strict=True) if gap <= reach]
    whole = [_joined(p, parts, looks) for p in near if p.length > PIECES * looks.length]
    rated = [(p.like(looks), k) for k, p in enumerate(whole) if p.may_be(looks)]
    if not rated:
        return None, 0.0
    like, k = max(rated)
    rivals = [r for r, j in rated if not (whole[j].mask & whole[k].mask).any()]
    sure = like >= (LIKE if np.isfinite(reach) else SURE)
    if not sure or max(rivals, default=0.0) > like - CLEAR:
        return None, like
    return whole[k], like


def _joined(part: Part, parts: Sequence[Part], looks: Part) -> Part:
    """A part with others of its colours beside it, where all together are no longer than the
    object: pieces of it."""
    others = [p for p in parts if p is not part and p.alike(looks) > LIKE]
    for other, gap in zip(others, part.gaps(others), strict=True):
        if gap > PIECES * looks.length:
            continue
        mask, share = part.mask | other.mask, part.area / (part.area + other.area)
        both = Part(mask, share * part.colors + (1 - share) * other.colors, length_of(mask))
        if both.length < LENGTHS[1] * looks.length:
            part = both
    return part


def _filled(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Without holes, such as those between strings."""
    return ndimage.binary_fill_holes(mask)
