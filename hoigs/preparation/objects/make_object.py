"""The object's track with colours: of a ball, of something held, or of an outline alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.objects.ball import BallTrack, ball_centers
from hoigs.preparation.objects.shape import ColorSampler, sphere_points
from hoigs.preparation.objects.track import held_object
from hoigs.preparation.objects.tracked import ObjectConfidence, UntrackableError, tracked_object

ObjectWay = Literal["auto", "outline"]

COLOR_FRAMES = 24  # a median over more changes nothing visible


def ball_object(
    ball: BallTrack, cameras: Sequence[Camera], radius: float, count: int
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float]:
    """A ball of known radius: track (grey), outward normals, spread of its measured radius."""
    points = sphere_points(count, radius)
    frames = len(cameras)
    track = ObjectTrack(
        points=points,
        colors=torch.full_like(points, 0.5),
        rotations=torch.eye(3).expand(frames, 3, 3).clone(),
        translations=ball_centers(ball, list(cameras), radius),
        observed=torch.from_numpy(ball.observed),
        provenance=(
            f"tracked disc, refined on its edge; depth from a radius of {radius} m and the focal "
            "length; its spin is not tracked"
        ),
    )
    return track, points / radius, ball.jitter


@dataclass(frozen=True)
class MadeObject:
    """The object's track with sampled colours.

    Attributes:
        spread: of its apparent over its expected size, relative.
        confidence: how far poses and shape may be trusted.
    """

    track: ObjectTrack
    spread: float
    confidence: ObjectConfidence


def make_object(
    ball: BallTrack | None,
    masks: MaskStack,
    humans: MaskStack,
    cameras: Sequence[Camera],
    joints: Float[Tensor, "F J 3"],
    images: Images,
    *,
    way: ObjectWay,
    radius: float,
    count: int,
    fps: float,
    progress: Callable[[float], None],
) -> MadeObject:
    """A ball's track, or that of something held by its texture; by its outline where that cannot
    be, and the confidence names why.

    Args:
        joints: of the body, world, metres. radius: of a ball, metres. count: of points.
    """
    if ball is not None:
        track, normals, spread = ball_object(ball, cameras, radius, count)
        confidence = ObjectConfidence.none("ball", len(cameras), "a ball's spin is not tracked")
    else:
        try:
            if way == "outline":
                raise UntrackableError("object_track is outline")
            track, normals, confidence = tracked_object(
                masks, humans, cameras, joints, images, count, fps, progress
            )
            spread = float(np.nanmean(confidence.outline) / track.points.norm(dim=-1).mean())
        except UntrackableError as reason:
            wrists = joints[:, [LEFT_WRIST, RIGHT_WRIST]]
            track, normals, spread = held_object(masks, list(cameras), wrists, count)
            confidence = ObjectConfidence.none("outline", len(cameras), str(reason))
    track = replace(track, colors=_colors(track, normals, masks, cameras, images))
    return MadeObject(track, spread, confidence)


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
