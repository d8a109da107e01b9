"""Undistortion: images, masks and depth of a lens with distortion, as a pinhole sees them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

FAR_OUTSIDE = -9.0  # in grid_sample's units, where the image spans -1..1


class Undistortion:
    """Maps a distorted image onto its pinhole camera.

    Args:
        source: [H, W, 2] where each pinhole pixel lies in the distorted frame, pixels; NaN where
            the lens sees nothing there. None if the frame is a pinhole image already.
        forward: distorted pixels [N, 2] to pinhole pixels [N, 2]; None for the identity.

    Attributes:
        outside: [H, W] pinhole pixels that the frame does not show; None where it shows all.
        shift: the farthest that a coordinate of a pixel is moved by, pixels.
    """

    def __init__(
        self,
        source: Float[np.ndarray, "H W 2"] | None = None,
        forward: Callable[[Any], Any] | None = None,
    ) -> None:
        self._forward = forward
        self._grid: Tensor | None = None
        self.outside: Bool[np.ndarray, "H W"] | None = None
        self.shift = 0.0
        if source is not None:
            height, width = source.shape[:2]
            size = np.array([width, height])
            y, x = np.mgrid[:height, :width] + 0.5
            self.shift = float(np.nanmax(np.abs(source - np.stack((x, y), -1))))
            with np.errstate(invalid="ignore"):
                inside = np.all((source >= 0) & (source <= size), axis=-1)
            grid = np.where(np.isfinite(source), 2 * source / size - 1, FAR_OUTSIDE)
            self._grid = torch.from_numpy(grid.astype(np.float32))[None]
            self.outside = None if inside.all() else np.logical_not(inside)

    def image(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Bilinear; pixels outside repeat the border."""
        if self._grid is None:
            return image
        out = torch.empty(image.shape, dtype=torch.uint8)
        # a channel at a time: large temporary arrays would fragment the heap among cached frames
        for channel, values in enumerate(torch.from_numpy(image).unbind(-1)):
            moved = torch.nn.functional.grid_sample(
                values.float()[None, None], self._grid, mode="bilinear", padding_mode="border",
                align_corners=False,
            )  # fmt: skip
            out[..., channel] = moved[0, 0].round_()
        return out.numpy()

    def mask(self, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
        """The nearest pixel; False outside."""
        return self._nearest(mask.astype(np.float32)) > 0.5

    def depth(self, depth: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
        """The nearest pixel, for depths across an edge have no mean; 0 (unknown) outside."""
        return self._nearest(depth)

    def pixels(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Positions in the frame, pixels; NaN stays NaN."""
        return xy if self._forward is None else self._forward(xy)

    def _nearest(self, values: np.ndarray) -> np.ndarray:
        if self._grid is None:
            return values
        moved = torch.nn.functional.grid_sample(
            torch.from_numpy(values)[None, None].float(), self._grid, mode="nearest",
            padding_mode="zeros", align_corners=False,
        )  # fmt: skip
        out = moved[0, 0].numpy()
        # grid_sample lets half a pixel beyond the border through
        return out if self.outside is None else np.where(self.outside, np.float32(0), out)
