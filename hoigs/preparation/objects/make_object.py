"""The object's track with colours: of a ball, or of something held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.objects.ball import BallTrack, ball_centers
from hoigs.preparation.objects.shape import ColorSampler, sphere_points
from hoigs.preparation.objects.track import held_object

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


def make_object(
    ball: BallTrack | None,
    masks: MaskStack,
    cameras: Sequence[Camera],
    wrists: Float[Tensor, "F 2 3"],
    images: Images,
    *,
    radius: float,
    count: int,
) -> tuple[ObjectTrack, float]:
    """The object's track with sampled colours, and its scale's spread."""
    if ball is not None:
        track, normals, spread = ball_object(ball, cameras, radius, count)
    else:
        track, normals, spread = held_object(masks, list(cameras), wrists, count)
    return replace(track, colors=_colors(track, normals, masks, cameras, images)), spread


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
