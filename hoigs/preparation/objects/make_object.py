"""The object's track with colours: of a ball, of something held, or of an outline alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.objects.ball.sphere import (
    Cones,
    NoBallError,
    ball_cones,
    clear_radius,
    contact_radius,
    require_round,
)
from hoigs.preparation.objects.ball.track import BallTrack, ball_centers
from hoigs.preparation.objects.doubts import silhouette_ious
from hoigs.preparation.objects.shape.first_points import ColorSampler, sphere_points
from hoigs.preparation.objects.track import held_object
from hoigs.preparation.objects.tracked import ObjectConfidence, UntrackableError, tracked_object

ObjectWay = Literal["auto", "ball", "texture", "outline"]

COLOR_FRAMES = 24  # a median over more changes nothing visible
FOOTBALL = 0.11  # metres
COVERED, COVERS_MORE = 0.7, 0.1  # IoU with the masks below which another way is tried, and is taken
FARTHEST_OUTLINE = 0.5  # of its size: what is farther off its masks is no object


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
    masks: MaskStack,
    humans: MaskStack,
    others: MaskStack,
    cameras: Sequence[Camera],
    joints: Float[Tensor, "F J 3"] | None,
    parents: Sequence[int],
    images: Images,
    *,
    way: ObjectWay,
    radius: float | None,
    count: int,
    fps: float,
    progress: Callable[[float], None],
    depths: Float[np.ndarray, " F"] | None = None,
) -> MadeObject:
    """A ball's track, or that of something held by its texture; by its outline where that cannot
    be, and the confidence names why.

    Args:
        others: pixels of other objects, which hide this one wherever the person's limbs are.
        joints: of the body, world, metres; None: nobody is there, and the object is at `depths`
            along the view. parents: of the joints. way: how; "auto": as a ball
            where all masks are round, or else by texture, or by outlines where these cover the
            masks better. radius: of a ball, metres; None: a
            football's for a tracked ball, and for a round mask that which the limbs at it give.
            count: of points.
    """
    hiding = MaskStack(h | o for h, o in zip(humans, others, strict=True))
    colored = partial(_colored, masks=masks, humans=hiding, cameras=cameras, images=images)
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
                cones, masks, cameras, joints, parents, radius, count
            )
            return colored(track, normals, cones.jitter, confidence)
        except NoBallError as reason:
            if way == "ball":
                reasons.append(f"it cannot be posed as a ball: {reason}")
    made = None
    try:
        if way == "outline":
            raise UntrackableError("object_track is outline")
        track, normals, confidence = tracked_object(
            masks, humans, others, cameras, joints, parents, images, count, fps, progress,
            depths=depths,
        )  # fmt: skip
        made = colored(track, normals, _spread(track, confidence), confidence)
        if way == "texture" or np.nanmean(made.ious) >= COVERED:
            return made
    except UntrackableError as reason:
        reasons.append(str(reason))
    wrists = None if joints is None else joints[:, [LEFT_WRIST, RIGHT_WRIST]]
    track, normals, spread = held_object(masks, list(cameras), wrists, count, depths)
    confidence = ObjectConfidence.none("outline", len(cameras), "; ".join(reasons))
    rough = colored(track, normals, spread, confidence)
    return rough if made is None else _better_covering(made, rough)


def _spread(track: ObjectTrack, confidence: ObjectConfidence) -> float:
    """How far the shape is off the masks' outlines, relative to its size.

    Raises:
        UntrackableError: so far that it is no shape.
    """
    spread = float(np.nanmean(confidence.outline) / track.points.norm(dim=-1).mean())
    if not spread < FARTHEST_OUTLINE:
        raise UntrackableError(
            f"the shape found by its texture is off its masks' outlines by {100 * spread:.0f} "
            f"% of its size ({100 * FARTHEST_OUTLINE:.0f} % at most)"
        )
    return spread


def _better_covering(made: MadeObject, rough: MadeObject) -> MadeObject:
    """The track by texture, unless that by outlines covers the masks much better."""
    by_texture, by_outline = float(np.nanmean(made.ious)), float(np.nanmean(rough.ious))
    if by_outline < by_texture + COVERS_MORE:
        return made
    reason = (
        f"the poses that its texture gives cover its masks by {by_texture:.2f} (IoU), those of its "
        f"outlines by {by_outline:.2f}: it may be shiny, or not rigid"
    )
    reasons = "; ".join(filter(None, (rough.confidence.reason, reason)))
    return replace(rough, confidence=replace(rough.confidence, reason=reasons))


def _colored(
    track: ObjectTrack,
    normals: Float[Tensor, "P 3"],
    spread: float,
    confidence: ObjectConfidence,
    masks: MaskStack,
    humans: MaskStack,
    cameras: Sequence[Camera],
    images: Images,
) -> MadeObject:
    track = replace(track, colors=_colors(track, normals, masks, cameras, images))
    ious = silhouette_ious(track, masks, humans, cameras)
    return MadeObject(track, spread, confidence, ious)


def _colors(
    track: ObjectTrack,
    normals: Float[Tensor, "P 3"],
    masks: MaskStack,
    cameras: Sequence[Camera],
    images: Images,
) -> Float[Tensor, "P 3"]:
    sampler = ColorSampler(track.points, normals)
    seen = np.flatnonzero(track.observed.numpy())
    chosen = set(seen[np.linspace(0, len(seen) - 1, COLOR_FRAMES).round().astype(int)].tolist())
    for i, image in enumerate(images()):
        if i in chosen:
            sampler.add(image, masks[i], cameras[i], track.rotations[i], track.translations[i])
    return sampler.colors()
