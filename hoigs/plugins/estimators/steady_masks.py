"""Masks of a still camera's frames, made to agree wherever the frames do.

A network that segments each frame by itself takes a white table for a part of a white shirt in one
frame and not in the next, and misses the shirt in a third. Where the camera stands still, a pixel
that looks the same in two frames shows the same thing in both. So wherever broad parts of a frame's
mask are not as most frames have them that look alike there, it takes these frames' label.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

LONGEST = 320  # pixels of the frames as they are compared
BUDGET = 100_000_000  # bytes that these may take; of longer videos they are smaller
VOTERS = 64  # frames, spread over the video, that have a say
ALIKE = 10  # of 255, in the channel that differs most
STILL = 0.8  # share of the pixels without people that look as usual; below it the camera moves
OFTEN = 0.2  # share of the voters that must look alike for a pixel to be changed
AGREED = 0.6  # share of these that changes it
BROAD = 4  # pixels, half the breadth of what is changed: what is narrower is an outline, or clothes
# in front of something of their colour


class SteadyMasks:
    """The masks of a video in agreement.

    Args:
        people: each person's masks, one a frame. images: these frames, of any one size.
        size: their width and height.

    Attributes:
        still: whether the camera stands still; if not, there is nothing to agree on.
    """

    def __init__(
        self,
        people: Sequence[Sequence[Any]],
        images: Iterable[UInt8[np.ndarray, "H W 3"]],
        size: tuple[int, int],
    ) -> None:
        self._people, count = people, len(people[0])
        cost = (3 + len(people)) * count * size[0] * size[1]
        scale = min(1.0, LONGEST / max(size), float(np.sqrt(BUDGET / cost)))
        self._size = (max(8, round(size[0] * scale)), max(8, round(size[1] * scale)))
        shape = (self._size[1], self._size[0])
        self._voters = np.unique(np.linspace(0, count - 1, min(count, VOTERS)).round().astype(int))
        self._images = np.empty((count, 3, *shape), np.uint8)
        self._masks = np.empty((len(people), count, *shape), bool)
        for i, image in enumerate(images):
            self._images[i] = _reduced(image, self._size).transpose(2, 0, 1)
            for k, masks in enumerate(people):
                self._masks[k, i] = _reduced(255 * masks[i].astype(np.uint8), self._size) > 127
        self.still = self._stands()

    def _stands(self) -> bool:
        usual = np.median(self._images[self._voters], 0).astype(np.uint8)
        free = np.logical_not(self._masks.any(0))
        shares = [
            _alike(self._images[i], usual)[free[i]].mean() for i in self._voters if free[i].any()
        ]
        return bool(shares) and float(np.median(shares)) >= STILL

    def mask(self, k: int, i: int) -> Bool[np.ndarray, "h w"]:
        """A person's mask of a frame, at the size that it was given."""
        mask, own = self._people[k][i], self._masks[k, i]
        alike = _alike(self._images[self._voters], self._images[i])
        often = alike.mean(0)
        share = (alike & self._masks[k, self._voters]).mean(0) / np.maximum(often, 1e-9)
        out = _broad(own & (often >= OFTEN) & (share <= 1 - AGREED))
        into = _broad(~own & (often >= OFTEN) & (share >= AGREED))
        share[~(out | into)] = 0.5
        height, width = mask.shape
        shares = _enlarged(share.astype(np.float32), (width, height))
        agreed: np.ndarray = (mask & (shares > 1 - AGREED)) | (shares >= AGREED)
        return agreed


def _alike(
    images: UInt8[np.ndarray, "*F 3 h w"], image: UInt8[np.ndarray, "3 h w"]
) -> Bool[np.ndarray, "*F h w"]:
    apart = np.maximum(images, image) - np.minimum(images, image)
    alike: np.ndarray = apart.max(-3) <= ALIKE
    return alike


def _broad(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Its parts that are not narrow."""
    core = ndimage.binary_opening(mask, iterations=BROAD)
    broad: np.ndarray = mask & ndimage.binary_dilation(core, iterations=BROAD)
    return broad


def _reduced(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))


def _enlarged(values: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "H W"]:
    return np.asarray(Image.fromarray(values).resize(size, Image.Resampling.BILINEAR))
