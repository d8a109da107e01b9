"""Images and masks at another size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image


def shrink(
    image: UInt8[np.ndarray, "H W 3"], width: int, height: int
) -> UInt8[np.ndarray, "h w 3"]:
    """The image at another size, area-averaged."""
    if (width, height) == image.shape[1::-1]:
        return image
    return np.array(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def shrink_mask(mask: Bool[np.ndarray, "H W"], width: int, height: int) -> Bool[np.ndarray, "h w"]:
    """The mask at another size, by nearest pixel."""
    if (width, height) == mask.shape[1::-1]:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * 255)
    return np.array(grey.resize((width, height), Image.Resampling.NEAREST)) > 127


def resized_mask(mask: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """The mask at another (width, height): pixels of which it covers half."""
    if mask.shape[::-1] == size:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * 255)
    return np.asarray(grey.resize(size, Image.Resampling.BOX)) > 127
