"""Where nothing was clicked: what moves beside the person near their hands, or what they hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.core.interfaces.estimator import FramePrompt, PromptPoint
from hoigs.plugins.estimators.object_tracker.colors import bins_of, histogram
from hoigs.plugins.estimators.object_tracker.footage import Footage
from hoigs.plugins.estimators.object_tracker.scene import Scene

SAMPLES = 24  # frames that are searched
AREA = (0.0003, 0.12)  # of the image, least and largest
WRISTS = (15, 16)  # among MediaPipe's landmarks


@dataclass(frozen=True)
class _Blob:
    frame: int
    point: tuple[float, float]
    score: float
    colors: np.ndarray


def proposed(
    footage: Footage,
    scene: Scene,
    hands: Float[np.ndarray, "F 2 2"] | None = None,
    taken: Bool[np.ndarray, "F h w"] | None = None,
) -> FramePrompt | None:
    """A click on the object, in pixels of the footage and positions of its frames.

    Where nothing moves beside the person, what the person's mask takes in far from their limbs is
    the thing that they hold.

    Args:
        hands: x, y of both in each frame, NaN where unknown. taken: pixels of other objects.
    """
    frames = np.unique(np.linspace(0, len(footage) - 1, SAMPLES).astype(int))
    beside = [None if hands is None else hands[i] for i in frames]
    others = [None if taken is None else taken[i] for i in frames]
    blobs: list[_Blob] = []
    for i, near, other in zip(frames, beside, others, strict=True):
        blobs += _free(footage, scene, int(i), near, other)
    if found := _recurring(blobs):
        return found
    blobs = []
    for i, near, other in zip(frames, beside, others, strict=True):
        blobs += _held(footage, int(i), near, other)
    return _recurring(blobs)


def _recurring(blobs: Sequence[_Blob]) -> FramePrompt | None:
    """Of a thing that is seen in many frames in the same colours, near the hands."""
    if not blobs:
        return None
    alike = np.sqrt(np.stack([b.colors for b in blobs]))
    likeness = (alike @ alike.T).clip(0, 1) ** 2
    scores = np.array([b.score for b in blobs])
    frames = np.array([b.frame for b in blobs])
    support = np.zeros(len(blobs))
    for i in np.unique(frames):
        rows = frames == i
        support += (likeness[:, rows] * scores[rows]).max(1)
    enough = support > 0.12 * SAMPLES * 0.5
    if not enough.any():
        return None
    best = blobs[int(np.argmax(support * np.sqrt(scores) * enough))]
    return FramePrompt(best.frame, (PromptPoint(*best.point),))


def _free(footage: Footage, scene: Scene, i: int, hands, taken) -> list[_Blob]:
    """Parts of one frame that differ from the scene and lie off the person."""
    person = footage.person[i]
    unit = max(1, round(0.004 * footage.diagonal))
    hidden = ndimage.binary_dilation(person, iterations=unit) | footage.blank[i]
    if taken is not None:
        hidden |= ndimage.binary_dilation(taken, iterations=2 * unit)
    moving = (np.nan_to_num(scene.difference(i), nan=0.0) > 6) & ~hidden
    apart = ndimage.distance_transform_edt(~person) if person.any() else None
    return _blobs(footage, i, moving, hands, apart)


def _held(footage: Footage, i: int, hands, taken) -> list[_Blob]:
    """Parts of the person's mask that no limb reaches, in other colours than the person's."""
    held = footage.held[i] if taken is None else footage.held[i] & ~taken
    bins = bins_of(footage.colors(i))
    body = histogram(bins, footage.body(i) * 1.0)
    return [
        replace(blob, score=blob.score * (1 - float(np.sqrt(blob.colors * body).sum())))
        for blob in _blobs(footage, i, held, hands, None)
    ]


def _blobs(footage: Footage, i: int, region: Bool[np.ndarray, "h w"], hands, apart) -> list[_Blob]:
    """The largest connected parts of a region of one frame."""
    unit = max(1, round(0.004 * footage.diagonal))
    region = ndimage.binary_closing(
        ndimage.binary_opening(region, iterations=unit), iterations=unit
    )
    labels, count = ndimage.label(region)
    if not count:
        return []
    bins = bins_of(footage.colors(i))
    found = []
    sizes = ndimage.sum_labels(region, labels, np.arange(1, count + 1))
    for k in np.argsort(-sizes)[:6]:
        area = sizes[k] / region.size
        if not AREA[0] <= area <= AREA[1]:
            continue
        blob = labels == k + 1
        depth = ndimage.distance_transform_edt(np.pad(blob, 1))[1:-1, 1:-1]
        y, x = np.unravel_index(depth.argmax(), depth.shape)
        round_ = float(np.pi * depth.max() ** 2 / sizes[k])  # 1 for a disc
        near = _nearness(blob, hands, apart, footage.diagonal)
        score = float(near * min(1.0, 1.6 * round_**0.5) * min(1.0, (area / 0.002) ** 0.5))
        found.append(_Blob(i, (float(x) + 0.5, float(y) + 0.5), score, histogram(bins, blob * 1.0)))
    return found


def _nearness(blob: np.ndarray, hands, apart, diagonal: float) -> float:
    """From 1 at the hands, or at the person where hands are unknown, falling with distance."""
    if hands is not None and np.isfinite(hands).all(-1).any():
        y, x = np.nonzero(blob)
        known = hands[np.isfinite(hands).all(-1)]
        gap = min(float(np.hypot(x - hx, y - hy).min()) for hx, hy in known)
    elif apart is not None:
        gap = float(apart[blob].min())
    else:
        gap = 0.0
    return 1 / (1 + (gap / (0.12 * diagonal)) ** 2)
