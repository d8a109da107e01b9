"""What makes an object's track doubtful: seen in its masks and the landmarks, and said."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.outlines import outlines_of

OFTEN = 0.25  # of the frames: from this on it is said
SECOND = 0.5  # of the largest part: a part that may be another object
ALIEN = 0.5  # of a person's landmarks on the object, median: the estimator took it for the person
VISIBLE = 0.5  # landmarks that are surer than this


def doubts(masks: MaskStack, landmarks: Float[Tensor, "F 33 3"] | None) -> list[str]:
    """Sentences for the report: the border cuts the object often, its mask has several large
    parts, or most of the person's landmarks lie on it.

    Args:
        landmarks: x, y in pixels and visibility, NaN where unknown; None: of nobody.
    """
    outlines = outlines_of(masks)
    seen = np.flatnonzero(outlines.observed)
    found = []
    cut = float((~outlines.whole[seen]).mean())
    if cut > OFTEN:
        found.append(
            f"the border of the image cuts the object in {100 * cut:.0f} % of the frames that show "
            "it: its shape and distance are known less well there"
        )
    parted = float(np.mean([_parted(masks[i]) for i in seen.tolist()]))
    if parted > OFTEN:
        found.append(
            f"the object's mask has two large parts in {100 * parted:.0f} % of the frames: if they "
            "are two objects, both are tracked as one; point at one of them (--object X,Y)"
        )
    shares = [] if landmarks is None else list(_on_object(masks, landmarks, seen.tolist()))
    if shares and float(np.median(shares)) > ALIEN:
        found.append(
            f"{100 * float(np.median(shares)):.0f} % of the person's landmarks lie on the object "
            f"(median of {len(shares)} frames): it may have been taken for the person; look at "
            "overlay.mp4"
        )
    return found


def silhouette_ious(
    track: ObjectTrack, masks: MaskStack, humans: MaskStack, cameras: Sequence[Camera]
) -> Float[np.ndarray, " F"]:
    """Of each frame, intersection over union of the mask and the outline of the track's points,
    without the person's pixels; NaN where it is not seen. A pixel counts as soon as a point lies
    in it, which costs an outline of 20 pixels a tenth."""
    found = np.full(len(masks), np.nan)
    for i in track.observed.nonzero().flatten().tolist():
        drawn = _drawn(track, i, cameras[i]) & ~humans[i]
        union = int((drawn | masks[i]).sum())
        found[i] = (drawn & masks[i]).sum() / union if union else np.nan
    return found


def _drawn(track: ObjectTrack, frame: int, camera: Camera) -> np.ndarray:
    """Pixels within the points' outline: the pixels of points, and the gaps between them."""
    world = track.points @ track.rotations[frame].mT + track.translations[frame]
    xy, depth = camera.project(world)
    at = xy[camera.shows(xy, depth)].long().numpy()
    drawn = np.zeros((camera.height, camera.width), bool)
    drawn[at[:, 1], at[:, 0]] = True
    if not len(at):
        return drawn
    # half of the points show their side: their spacing in pixels
    spacing = int(np.ceil(np.sqrt(2 * np.prod(np.ptp(at, axis=0) + 1) / len(at)))) + 1
    (x0, y0), (x1, y1) = at.min(0), at.max(0) + 1
    part = np.pad(drawn[y0:y1, x0:x1], spacing)
    part = ndimage.binary_closing(part, iterations=spacing)
    drawn[y0:y1, x0:x1] = ndimage.binary_fill_holes(part)[spacing:-spacing, spacing:-spacing]
    return drawn


def _parted(mask: np.ndarray) -> bool:
    labels, count = ndimage.label(mask)
    if count < 2:
        return False
    sizes = np.sort(np.bincount(labels.ravel())[1:])
    return bool(sizes[-2] > SECOND * sizes[-1])


def _on_object(
    masks: MaskStack, landmarks: Float[Tensor, "F 33 3"], frames: Sequence[int]
) -> Iterator[float]:
    for i in frames:
        mask, marks = masks[i], landmarks[i].numpy()
        marks = marks[np.isfinite(marks).all(-1)]
        xy = marks[marks[:, 2] > VISIBLE, :2].astype(int)
        if len(xy):
            inside = ((xy >= 0) & (xy < [mask.shape[1], mask.shape[0]])).all(-1)
            yield float(mask[xy[inside, 1], xy[inside, 0]].sum() / len(xy))
