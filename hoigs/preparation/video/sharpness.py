"""How sharp a frame is, compared with its neighbours."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

WIDTH = 640  # at which frames are compared: motion blur that matters shows there


class Grey(Protocol):
    """A picture that gives its brightness at a width."""

    def grey(self, width: int) -> UInt8[np.ndarray, "h w"]: ...


def sharpness(picture: Grey) -> float:
    """Standard deviation of the Laplacian over that of the brightness, at a width of 640.

    The variance of the Laplacian (Pech-Pacheco et al. 2000), divided by the contrast so that a
    change of exposure is not taken for blur. It compares frames of one scene; between scenes it
    means nothing. 0 for a frame of one colour.
    """
    grey = picture.grey(WIDTH).astype(np.float32)
    contrast = float(grey.std())
    return float(ndimage.laplace(grey).std()) / contrast if contrast > 0 else 0.0
