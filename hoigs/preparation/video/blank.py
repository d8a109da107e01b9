"""Pixels that hold no picture: painted over, outside a stabilised frame, letterbox bars.

They are not part of the scene, and they differ from frame to frame, so a static scene would
otherwise be trained and scored on pixels that no camera saw.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

BLACK = 2  # of 255: a lens and a codec never leave a real surface this dark and this flat
NEARLY_BLACK = 16  # the codec's ringing at the border of what was painted
SMALLEST = 5e-4  # of the image
MARGIN = 2  # pixels that the border mixes


def blank_pixels(
    image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Flat black patches outside the masks of what moves (black shoes are no blank)."""
    darkness = image.max(-1)
    black = ndimage.binary_opening((darkness <= BLACK) & ~moving, iterations=1)
    labels, count = ndimage.label(black)
    if count == 0:
        return np.zeros_like(black)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    patches = (sizes >= max(16, SMALLEST * black.size))[labels]
    around = (darkness <= NEARLY_BLACK) & ~moving
    grown = ndimage.binary_propagation(patches, mask=around | patches)
    return ndimage.binary_dilation(grown, iterations=MARGIN) & ~moving if grown.any() else grown
