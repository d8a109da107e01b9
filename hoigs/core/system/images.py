"""Pillow's images of any depth as 8 bits a channel: its own `convert` clips greys of 16 bits."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image

WHITE_16 = 65535


def eight_bits(image: Image.Image) -> Image.Image:
    """The image; one of 16-bit greys (modes I;16, I) at the same brightness in 8 bits (L).

    Raises:
        ValueError: greys of more than 16 bits, or of floating point, which have no white.
    """
    if image.mode != "F" and not image.mode.startswith("I"):
        return image
    values = np.asarray(image)
    if image.mode == "F" or values.min(initial=0) < 0 or values.max(initial=0) > WHITE_16:
        raise ValueError(
            f"greys of mode {image.mode} from {values.min():g} to {values.max():g}, expected whole "
            f"numbers of 0 to 255 or 0 to {WHITE_16}"
        )
    return Image.fromarray((values / (WHITE_16 / 255)).round().astype(np.uint8))


def mask_values(image: Image.Image) -> UInt8[np.ndarray, "H W"]:
    """A mask's values: its alpha channel, unless that is opaque all over; else its brightness,
    which is 0 where the file has 0 only.

    Raises:
        ValueError: as `eight_bits`.
    """
    if "A" in image.getbands():
        alpha = np.asarray(image.getchannel("A"))
        if (alpha < 255).any():
            return alpha
    grey = np.asarray(eight_bits(image).convert("L"))
    return np.maximum(grey, np.asarray(image) > 0) if image.mode.startswith("I") else grey
