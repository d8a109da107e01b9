"""The object's track with colours: of a ball, of something held, or of an outline alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.mask_stack import MaskStack, outlines_of
from hoigs.preparation.objects.ball import (
    BallTrack,
    Cones,
    NoBallError,
    ball_centers,
    ball_cones,
    clear_radius,
    contact_radius,
    require_round,
)
from hoigs.preparation.objects.explained import colors_of, held_back_error, silhouette_ious
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.plate import plate_object
from hoigs.preparation.objects.rod import breadth_of, rod_object
from hoigs.preparation.objects.shape import held_object, sphere_points
from hoigs.preparation.objects.tracked import ObjectConfidence, tracked_object
from hoigs.preparation.objects.watched import UntrackableError, watched
from hoigs.preparation.options import ObjectWay

# What makes an object's track doubtful: seen in its masks and the landmarks, and said.

OFTEN = 0.25  # of the frames: from this on it is said
SECOND = 0.5  # of the largest part: a part that may be another object
BESIDE = 0.5  # of the object's area: with so much of a person beside it, it is not the person
ALIEN = 0.5  # of a person's landmarks on the object, median: the estimator took it for the person
VISIBLE = 0.5  # landmarks that are surer than this


def doubts(
    masks: MaskStack,
    landmarks: Float[Tensor, "F 33 3"] | None,
    humans: MaskStack | None = None,
    rod: bool = False,
) -> list[str]:
    """Sentences for the report: the border cuts the object often, its mask has several large
    parts, or most of the person's landmarks lie on it, and little of the person is beside it.

    Args:
        landmarks: x, y in pixels and visibility, NaN where unknown; None: of nobody.
        humans: of people, without the object; None: not known.
        rod: the object is one, whose parts a hand and what is before it divide.
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
    if parted > OFTEN and not rod:
        found.append(
            f"the object's mask has two large parts in {100 * parted:.0f} % of the frames: if they "
            "are two objects, both are tracked as one; point at one of them (--object X,Y)"
        )
    shares = [] if landmarks is None else list(_on_object(masks, landmarks, seen.tolist()))
    areas = [] if humans is None else [humans[i].sum() / masks[i].sum() for i in seen.tolist()]
    beside = bool(areas) and float(np.median(areas)) > BESIDE  # it is held before the person
    if shares and not beside and float(np.median(shares)) > ALIEN:
        found.append(
            f"{100 * float(np.median(shares)):.0f} % of the person's landmarks lie on the object "
            f"(median of {len(shares)} frames): it may have been taken for the person; look at "
            "overlay.mp4"
        )
    return found


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


FOOTBALL = 0.11  # metres
THREAD = 6.0  # pixels: what is no broader shows no texture
BETTER = 0.9  # of the error of poses by texture: what the outlines' must be below to be taken


def ball_object(
    ball: BallTrack, cameras: Sequence[Camera], radius: float, count: int
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float]:
    """A tracked ball of known radius: track (grey), outward normals, spread of its measured
    radius."""
    places = ball_centers(ball, list(cameras), radius)
    text = (
        f"tracked disc, refined on its edge; depth from a radius of {radius} m and the focal "
        "length; its spin is not tracked"
    )
    return *_sphere_track(places, ball.observed, radius, count, text), ball.jitter


def round_object(
    cones: Cones,
    masks: MaskStack,
    cameras: Sequence[Camera],
    joints: Float[Tensor, "F J 3"] | None,
    parents: Sequence[int],
    radius: float | None,
    count: int,
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], ObjectConfidence]:
    """A ball of round masks: track (grey), outward normals, and how far it may be trusted."""
    touched = clear = None
    if radius is None and joints is not None:
        touched = contact_radius(cones, joints, cameras)
        clear = clear_radius(cones, masks, joints, parents, cameras)
    if radius is not None:
        size, text = radius, f"its radius was given as {radius:g} m"
    elif touched is not None:
        size, frames, spread = touched
        text = (
            f"its radius of {size:.3f} m puts it as far off as the hand, foot or head at it "
            f"({frames} frames, which differ by {100 * spread:.0f} %)"
        )
    else:
        size, text = FOOTBALL, f"no limb comes near it: its radius is taken as {FOOTBALL} m"
    if clear is not None and clear[0] < size:
        size = clear[0]
        text += (
            f", but only {size:.3f} m keep it in front of the limbs that it hides "
            f"({clear[1]} frames)"
        )
    places, off = cones.places(cameras, size), f"{100 * max(0.01, np.median(cones.judged)):.0f} %"
    track, normals = _sphere_track(
        places, cones.observed, size, count,
        f"taken for a ball, as its masks are {off} off a circle "
        f"(median of {len(cones.judged)} frames); place from the cone of rays along its outline; "
        f"{text}; its rotation is unknown, and kept constant",
    )  # fmt: skip
    away = np.linalg.norm(places - torch.stack([c.center for c in cameras]), axis=-1)
    nothing = np.full(len(cameras), np.nan)
    reason = (
        f"it was taken for a ball (masks {off} off a circle), whose rotation no outline shows; "
        f"{text}"
    )
    confidence = ObjectConfidence(
        "ball", nothing, cones.off * cones.angles * away, hand_distance=nothing, reason=reason
    )
    return track, normals, confidence


def _sphere_track(
    places: Float[Tensor, "F 3"],
    observed: Bool[np.ndarray, " F"],
    radius: float,
    count: int,
    provenance: str,
) -> tuple[ObjectTrack, Float[Tensor, "P 3"]]:
    points = sphere_points(count, radius)
    track = ObjectTrack(
        points=points,
        colors=torch.full_like(points, 0.5),
        rotations=torch.eye(3).expand(len(places), 3, 3).clone(),
        translations=places,
        observed=torch.from_numpy(observed),
        provenance=provenance,
        rotation_known=False,
    )
    return track, points / radius


@dataclass(frozen=True)
class MadeObject:
    """The object's track with sampled colours.

    Attributes:
        spread: of its apparent over its expected size, relative.
        confidence: how far poses and shape may be trusted.
        ious: of each frame, intersection over union of its outline and the mask; NaN if not seen.
    """

    track: ObjectTrack
    spread: float
    confidence: ObjectConfidence
    ious: Float[np.ndarray, " F"]


def make_object(
    ball: BallTrack | None,
    filmed: Filmed,
    *,
    way: ObjectWay,
    radius: float | None,
    count: int,
    progress: Callable[[float], None],
) -> MadeObject:
    """A ball's track, or that of something held by its texture; by its outline where that cannot
    be, and the confidence names why.

    Args:
        way: how; "auto": as a ball where all masks are round, or else as a rod, as something flat,
            as any body by its texture, or by outlines: what explains frames that are held back
            better.
        radius: of a ball, metres; None: a football's for a tracked ball, and for a round mask that
            which the limbs at it give.
        count: of points.
    """
    masks, cameras, joints = filmed.masks, filmed.cameras, filmed.joints
    hiding = filmed.hiding()
    colored = partial(_colored, filmed)
    if ball is not None:
        track, normals, spread = ball_object(ball, cameras, radius or FOOTBALL, count)
        confidence = ObjectConfidence.none("ball", len(cameras), "a ball's spin is not tracked")
        return colored(track, normals, spread, confidence)
    reasons = []
    if way in ("auto", "ball"):
        try:
            cones = ball_cones(masks, hiding, cameras)
            if way == "auto":
                require_round(cones, cameras)
            track, normals, confidence = round_object(
                cones, masks, cameras, joints, filmed.parents, radius, count
            )
            return colored(track, normals, cones.jitter, confidence)
        except NoBallError as reason:
            if way == "ball":
                reasons.append(f"it cannot be posed as a ball: {reason}")
    turning: list[_Turning] = []
    if way in ("auto", "rod"):
        try:
            turning.append(_Turning(*rod_object(filmed, count)))
        except UntrackableError as reason:
            reasons.append(f"it cannot be posed as a rod: {reason}")
    if not (turning and breadth_of(masks) <= THREAD):
        others, failed = _turning(filmed, way, count, progress)
        turning, reasons = turning + others, reasons + failed
    if turning and way != "auto":
        return _made(filmed, turning[0])
    track, normals, spread = held_object(filmed, count)
    if turning:
        errors = [held_back_error(one.track, one.normals, filmed) for one in turning]
        best = int(np.argmin(errors))
        if errors[0] <= errors[best] / BETTER:
            best = 0  # the rod, or else the flat thing, which is said in fewest numbers
        error = held_back_error(track, normals, filmed)
        if error > BETTER * errors[best]:
            return _made(filmed, turning[best])
        reasons.append(
            f"in frames held back, what its texture gives is {errors[best]:.3f} off in colour (of "
            f"1), what its outlines give {error:.3f}: it may be shiny, or not rigid"
        )
    confidence = ObjectConfidence.none("outline", len(cameras), "; ".join(reasons))
    return colored(track, normals, spread, confidence)


@dataclass(frozen=True)
class _Turning:
    """A track whose rotation is known, grey, with its points' outward normals."""

    track: ObjectTrack
    normals: Float[Tensor, "P 3"]
    spread: float
    confidence: ObjectConfidence


def _turning(
    filmed: Filmed, way: ObjectWay, count: int, progress: Callable[[float], None]
) -> tuple[list[_Turning], list[str]]:
    """Tracks by texture, of a flat thing and of any other, and why there are no more of them."""
    if way in ("outline", "rod"):
        return [], [f"object_track is {way}"]
    found, reasons = [], []
    try:
        seen = watched(filmed)
    except UntrackableError as reason:
        return [], [str(reason)]
    if way in ("auto", "plate"):
        try:
            found.append(_Turning(*plate_object(seen, count, lambda done: progress(done / 3))))
        except UntrackableError as reason:
            reasons.append(f"it cannot be posed as something flat: {reason}")
    if way in ("auto", "texture"):
        try:
            track, normals, confidence = tracked_object(
                seen, count, lambda done: progress((1 + 2 * done) / 3)
            )
            spread = float(np.nanmean(confidence.outline) / track.points.norm(dim=-1).mean())
            found.append(_Turning(track, normals, spread, confidence))
        except UntrackableError as reason:
            reasons.append(str(reason))
    return found, reasons


def _made(filmed: Filmed, one: _Turning) -> MadeObject:
    return _colored(filmed, one.track, one.normals, one.spread, one.confidence)


def _colored(
    filmed: Filmed,
    track: ObjectTrack,
    normals: Float[Tensor, "P 3"],
    spread: float,
    confidence: ObjectConfidence,
) -> MadeObject:
    track = replace(track, colors=colors_of(track, normals, filmed))
    return MadeObject(track, spread, confidence, silhouette_ious(track, filmed))
