"""Panes: two pictures in one canvas, beside each other, divided by a wipe, or blended."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from hoigs.core.values.camera import Camera

Layout = Literal["one", "beside", "wipe", "blend"]
Draw = Callable[[Camera], UInt8[np.ndarray, "H W 3"]]  # a picture of the camera's size
CameraOf = Callable[[tuple[int, int]], Camera]  # the camera for a canvas of this size


def joined(
    layout: Layout,
    share: float,
    size: tuple[int, int],
    camera_of: CameraOf,
    first: Draw,
    second: Draw,
) -> UInt8[np.ndarray, "H W 3"]:
    """Both pictures in one.

    Args:
        layout: "beside" gives each half of the width and its own camera of the same field of view;
            "wipe" and "blend" draw both from one camera.
        share: of the width at which the wipe stands, or of the second picture in the blend.
        size: width and height, pixels.
    """
    width, height = size
    if layout == "beside":
        left = width // 2
        halves = [d(camera_of((w, height))) for d, w in ((first, left), (second, width - left))]
        halves[1][:, :1] = 255  # a line between them
        return np.concatenate(halves, 1)
    camera = camera_of(size)
    if layout == "blend":
        a, b = first(camera).astype(np.float32), second(camera).astype(np.float32)
        return np.rint(a + (b - a) * share).astype(np.uint8)
    at = min(max(round(share * width), 1), width - 1)
    image = first(camera).copy()
    image[:, at:] = second(camera)[:, at:]
    image[:, at - 1 : at + 1] = 255
    return image
