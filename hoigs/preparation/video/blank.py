"""Pixels that hold no picture: painted over, outside a stabilised frame, letterbox bars.

They are not part of the scene, and they differ from frame to frame, so a static scene would
otherwise be trained and scored on pixels that no camera saw.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError

BLACK = 2  # of 255: a lens and a codec never leave a real surface this dark and this flat
NEARLY_BLACK = 16  # the codec's ringing at the border of what was painted
SMALLEST = 5e-4  # of the image
MARGIN = 2  # pixels that the border mixes
PROBES = 5  # frames, one of which must show something


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


def require_pictures(frames: Frames) -> None:
    """That a video shows something.

    Raises:
        SourceError: some frames from all over it are all black.
    """
    places = np.linspace(0, len(frames) - 1, min(PROBES, len(frames))).round().astype(int)
    brightest = 0
    for place in places.tolist():  # the first one settles it for nearly every video
        brightest = max(brightest, int(np.quantile(frames.read(frames.indices[place]), 0.99)))
        if brightest > NEARLY_BLACK:
            return
    raise SourceError(
        f"{frames.path} is black: in {len(places)} frames from all over it nothing is brighter "
        f"than {brightest} of 255"
    )
