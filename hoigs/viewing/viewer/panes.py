"""Panes: two pictures in one canvas, beside each other, divided by a wipe, or blended."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt8

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip

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


# Pictures of the video, and its cameras, fitted into a canvas of another size and aspect.


def nearest_position(clip: Clip, frame: float) -> int:
    """The position in the clip whose frame number is nearest."""
    return min(range(len(clip)), key=lambda i: abs(clip.moments[i].index - frame))


def source_frame(clip: Clip, frame: float, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
    """The video's nearest frame in the middle of a picture of the camera's size."""
    image = clip.store.image(nearest_position(clip, frame)).numpy()
    return placed(image, (camera.width, camera.height))


def covered(clip: Clip, camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Where `source_frame` has the video, and not the black around it."""
    first = clip.cameras[0]
    canvas = camera.width, camera.height
    left, top, width, height = inner_rectangle((first.width, first.height), canvas)
    inside = np.zeros((camera.height, camera.width), bool)
    inside[top : top + height, left : left + width] = True
    return inside


def placed(
    image: UInt8[np.ndarray, "h w 3"], canvas: tuple[int, int]
) -> UInt8[np.ndarray, "H W 3"]:
    """An image fitted into the middle of a canvas (width, height), with black around it."""
    from PIL import Image

    source = Image.fromarray(image)
    left, top, width, height = inner_rectangle(source.size, canvas)
    whole = Image.new("RGB", canvas)
    whole.paste(source.resize((width, height), Image.Resampling.BILINEAR), (left, top))
    return np.array(whole)


def inner_rectangle(image: tuple[int, int], canvas: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, width and height of an image that is fitted into the middle of a canvas."""
    scale = min(canvas[0] / image[0], canvas[1] / image[1])
    width, height = max(1, round(image[0] * scale)), max(1, round(image[1] * scale))
    return (canvas[0] - width) // 2, (canvas[1] - height) // 2, width, height
