"""Points of a background seen by a camera that never moves: its depth can only be supposed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.core.camera import Camera

REFERENCE_WIDTH = 640  # the spacing of points is given at this width
PLATE_FRAMES = 48  # a median over more frames changes nothing visible
MASK_MARGIN = 4  # pixels at 640: soft edges, motion blur and shadows at the feet


@dataclass(frozen=True)
class Plate:
    """The background without what moves.

    Attributes:
        image: RGB, 0..255; pixels never seen are copied from the nearest seen.
        seen: pixels that some frame shows.
    """

    image: UInt8[np.ndarray, "H W 3"]
    seen: Bool[np.ndarray, "H W"]


def background_plate(
    frames: Iterable[tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]], margin: int
) -> Plate:
    """Median colour over time of each pixel outside the masks, which are grown by `margin`.

    Args:
        frames: images with masks of everything that moves; a few dozen suffice.
    """
    images, hidden = [], []
    for image, mask in frames:
        images.append(image)
        hidden.append(ndimage.binary_dilation(mask, iterations=margin) if margin else mask)
    stack, covered = np.stack(images), np.stack(hidden)
    stack = np.sort(np.where(covered[..., None], np.uint8(255), stack), axis=0)
    visible = (~covered).sum(0)
    # the visible values are sorted to the front: covered ones became 255
    middle = np.maximum(visible - 1, 0) // 2
    median = np.take_along_axis(stack, middle[None, ..., None].astype(np.int64), axis=0)[0]
    seen = visible > 0
    if not seen.all() and seen.any():
        rows, columns = ndimage.distance_transform_edt(
            ~seen, return_distances=False, return_indices=True
        )
        median = median[rows, columns]
    return Plate(median, seen)


def supposed_depth(
    camera: Camera, ground: float, backdrop: float, pixels: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch"]:
    """Depth of a level floor below a level camera, ended by a wall.

    Args:
        camera: level, so that its y axis points down. ground: height of the camera over the floor,
            metres. backdrop: depth of the wall, metres.
        pixels: x, y.

    Returns:
        metres along z: ground / tan(angle below the horizon), at most `backdrop`.
    """
    below = (pixels[..., 1] - camera.K[1, 2]) / camera.K[1, 1]
    floor = ground / below.clamp_min(ground / backdrop)
    return floor.clamp_max(backdrop)


def plate_points(
    plate: Plate, camera: Camera, *, ground: float, backdrop: float, spacing: float
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """A regular grid of points on floor and wall, with the plate's colours.

    Args:
        camera: of the plate's size. spacing: of the grid at 640 pixels' width, pixels.

    Returns:
        points in the world, metres, and RGB in [0, 1].
    """
    step = spacing * camera.width / REFERENCE_WIDTH
    x = torch.arange(step / 2, camera.width, step)
    y = torch.arange(step / 2, camera.height, step)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    depth = supposed_depth(camera, ground, backdrop, pixels)
    column, row = pixels.floor().long().unbind(-1)
    size = max(1, round(step))
    # the mean over a grid cell, so that a point is not the colour of one leaf
    blurred = ndimage.uniform_filter(plate.image.astype(np.float32), (size, size, 0))
    colors = torch.from_numpy(blurred[row.numpy(), column.numpy()] / 255.0).clamp(0, 1)
    return camera.unproject(pixels, depth), colors
