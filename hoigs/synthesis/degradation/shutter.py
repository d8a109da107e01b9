"""Motion blur: each image is the mean of the frames around it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from hoigs.synthesis.generate import TrueView
from hoigs.synthesis.room.textures import to_linear, to_srgb

Array = np.ndarray
Moments = Iterable[tuple[TrueView, list[TrueView]]]


def with_shutter(moments: Moments, frames: int) -> Iterator[tuple[TrueView, list[TrueView]]]:
    """`SyntheticScene.views` with the images of the path's camera blurred over time.

    Masks, depth and held-out views stay those of the middle frame. The ends have fewer frames.

    Args:
        frames: an odd number; 1 changes nothing.
    """
    reach = frames // 2
    if reach == 0:
        yield from moments
        return
    known = list(moments)
    for i, (view, held_out) in enumerate(known):
        window = [other.image for other, _ in known[max(0, i - reach) : i + reach + 1]]
        yield replace(view, image=mean_image(window)), held_out


def mean_image(images: list[UInt8[Array, "H W 3"]]) -> UInt8[Array, "H W 3"]:
    """The mean of sRGB images in linear light, as a sensor adds them."""
    light = np.mean([to_linear(image / 255.0) for image in images], axis=0)
    mean: UInt8[Array, "H W 3"] = np.round(255 * to_srgb(light)).astype(np.uint8)
    return mean
