"""Colours of the object against colours of everything else: two histograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

BINS = (20, 32, 32)  # of lightness and the two axes of chroma
LOW, WIDE = (np.array(v, np.float32) for v in ((0, -64, -64), (3.9, 4, 4)))
LIMIT = 3.0  # largest log-odds that a colour may give


def bins_of(features: Float[np.ndarray, "... 3"]) -> Int[np.ndarray, "..."]:
    """The histogram's bin of each colour."""
    cell = ((features - LOW) / WIDE).astype(np.int32)
    cell = np.clip(cell, 0, np.array(BINS, np.int32) - 1)
    return (cell[..., 0] * BINS[1] + cell[..., 1]) * BINS[2] + cell[..., 2]


def histogram(bins: Int[np.ndarray, "..."], weights: Float[np.ndarray, "..."]) -> np.ndarray:
    """Share of each bin; a little blurred, since a colour varies from frame to frame."""
    counted = np.bincount(bins.ravel(), weights.ravel(), minlength=int(np.prod(BINS)))
    smooth = ndimage.gaussian_filter(counted.reshape(BINS), 0.8, mode="nearest").ravel()
    return (smooth / max(smooth.sum(), 1e-9)).astype(np.float32)


def odds_of(inside: np.ndarray, outside: np.ndarray) -> Float[np.ndarray, "B"]:
    """Log-odds of each bin for a pixel to be inside, both being equally probable before."""
    tiny = 2e-4
    return np.clip(np.log((inside + tiny) / (outside + tiny)), -LIMIT, LIMIT).astype(np.float32)


@dataclass(frozen=True)
class ColorModel:
    """Histograms of the object and of the rest."""

    inside: np.ndarray
    outside: np.ndarray

    def odds(self, bins: Int[np.ndarray, "..."], near: np.ndarray | None = None) -> np.ndarray:
        """Log-odds of each pixel. near: a histogram of the surroundings in this frame."""
        outside = self.outside if near is None else 0.5 * (self.outside + near)
        return odds_of(self.inside, outside)[bins]

    def likeness(self, other: np.ndarray) -> float:
        """Bhattacharyya coefficient of a region's histogram and the object's."""
        return float(np.sqrt(self.inside * other).sum())

    def blended(self, inside: np.ndarray, share: float) -> ColorModel:
        return ColorModel((1 - share) * self.inside + share * inside, self.outside)
