"""Metres a unit of a reconstructed scene: the ground under the feet is as far as the feet are."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.values.camera import Camera, pinhole_pixels

SIDE, ABOVE = 0.15, 0.04  # half size of the window about a foot's point, in image widths
ENOUGH_POINTS, ENOUGH_FRAMES = 4, 3


def ground_scale(
    feet: Float[Tensor, "F P 3"],
    points: Float[Tensor, "S 3"],
    cameras: Sequence[Camera],
    seen: Bool[Tensor, " F"],
) -> tuple[float, int] | None:
    """Ratio of the feet's depth to that of the scene points seen beside them.

    A foot stands on what the picture shows beside it. A foot in the air has farther ground behind
    it, which gives too small a scale, so of each frame's points only the half with the largest
    scale count; the median over frames removes the effect of jumps and of points elsewhere.

    Args:
        feet: heels and toes along each camera's axes, metres.
        points: of the scene, in the cameras' own unit.
        seen: frames to look at.

    Returns:
        The scale and the number of frames that gave it; None with fewer than three such frames.
    """
    ratios = []
    for i in seen.nonzero().squeeze(1).tolist():
        camera = cameras[i]
        pixels, depth = camera.project(points)
        inside = (depth > 0) & (pixels[:, 1] < camera.height) & (pixels[:, 1] > 0)
        at = pinhole_pixels(camera.K, feet[i])
        off = (pixels[:, None] - at).abs() / camera.width
        near = (off[..., 0] < SIDE) & (off[..., 1] < ABOVE) & inside[:, None]
        enough = near.sum(0) >= ENOUGH_POINTS
        of_feet = [
            feet[i, foot, 2] / depth[near[:, foot]].median()
            for foot in enough.nonzero().squeeze(1).tolist()
        ]
        if of_feet:
            ratios.append(_mean_of_upper_half(torch.stack(of_feet)))
    if len(ratios) < ENOUGH_FRAMES:
        return None
    return float(torch.stack(ratios).median()), len(ratios)


def _mean_of_upper_half(values: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    return values.sort(descending=True).values[: (len(values) + 1) // 2].mean()
