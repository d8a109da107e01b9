"""Lens: how a real camera maps rays to pixels, in COLMAP's models, and to a pinhole."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.errors import ClipError, did_you_mean
from hoigs.core.maths.optics import Model, Optics
from hoigs.core.values.camera import Camera

# Undistortion: images, masks and depth of a lens with distortion, as a pinhole sees them.

Margins = tuple[int, int, int, int]  # left, top, right, bottom; pixels
FAR_OUTSIDE = -9.0  # in grid_sample's units, where the image spans -1..1


class Undistortion:
    """Maps a distorted image onto its pinhole camera.

    Args:
        source: [Hp, Wp, 2] where each pinhole pixel lies in the distorted frame, pixels; NaN where
            the lens sees nothing there. None if the frame is a pinhole image already.
        forward: distorted pixels [N, 2] to pinhole pixels [N, 2]; None for the identity.
        margins: pixels by which the pinhole image is larger, see `Lens.margins`.

    Attributes:
        outside: [Hp, Wp] pinhole pixels that the frame does not show; None where it shows all.
        shift: the farthest that a coordinate of a pixel is moved by, pixels.
    """

    def __init__(
        self,
        source: Float[np.ndarray, "Hp Wp 2"] | None = None,
        forward: Callable[[Any], Any] | None = None,
        margins: Margins = (0, 0, 0, 0),
    ) -> None:
        self._forward = forward
        self._grid: Tensor | None = None
        self.outside: Bool[np.ndarray, "Hp Wp"] | None = None
        self.shift = 0.0
        if source is not None:
            left, top, right, bottom = margins
            size = np.array([source.shape[1] - left - right, source.shape[0] - top - bottom])
            y, x = np.mgrid[: size[1], : size[0]] + 0.5
            within = source[top : top + size[1], left : left + size[0]]
            self.shift = float(np.nanmax(np.abs(within - np.stack((x, y), -1))))
            with np.errstate(invalid="ignore"):
                inside = np.all((source >= 0) & (source <= size), axis=-1)
            grid = np.where(np.isfinite(source), 2 * source / size - 1, FAR_OUTSIDE)
            self._grid = torch.from_numpy(grid.astype(np.float32))[None]
            self.outside = None if inside.all() else np.logical_not(inside)

    def image(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "Hp Wp 3"]:
        """Bilinear; pixels outside repeat the border."""
        if self._grid is None:
            return image
        out = torch.empty(*self._grid.shape[1:3], 3, dtype=torch.uint8)
        # a channel at a time: large temporary arrays would fragment the heap among cached frames
        for channel, values in enumerate(torch.from_numpy(image).unbind(-1)):
            moved = torch.nn.functional.grid_sample(
                values.float()[None, None], self._grid, mode="bilinear", padding_mode="border",
                align_corners=False,
            )  # fmt: skip
            out[..., channel] = moved[0, 0].round_()
        return out.numpy()

    def mask(self, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "Hp Wp"]:
        """The nearest pixel; False outside."""
        return self._nearest(mask.astype(np.float32)) > 0.5

    def depth(self, depth: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "Hp Wp"]:
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


PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# COLMAP's lenses as `Optics`: model, and where k1, k2, … and p1, p2 are among the parameters
OPTICS: dict[str, tuple[Model, Sequence[int], Sequence[int]]] = {
    "SIMPLE_RADIAL": ("pinhole", (3,), ()),
    "RADIAL": ("pinhole", (3, 4), ()),
    "OPENCV": ("pinhole", (4, 5), (6, 7)),
    "FULL_OPENCV": ("pinhole", (4, 5, 8, 9, 10, 11), (6, 7)),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", (3,), ()),
    "RADIAL_FISHEYE": ("fisheye", (3, 4), ()),
    "OPENCV_FISHEYE": ("fisheye", (4, 5, 6, 7), ()),
}
NEGLIGIBLE_SHIFT = 0.01  # pixels of distortion below which a lens counts as a pinhole


@dataclass(frozen=True)
class Lens:
    """Intrinsics with distortion.

    Attributes:
        model: COLMAP's name: "PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", …
        params: in COLMAP's order for that model; the centre of the top-left pixel is (0.5, 0.5).
        width, height: image size, pixels.

    Raises:
        ClipError: no such model, or another number of parameters.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self) -> None:
        _ = self._colmap

    @staticmethod
    def opencv(
        K: Float[np.ndarray, "3 3"],
        distortion: Sequence[float],
        width: int,
        height: int,
        *,
        pixel_center: float = 0.5,
    ) -> Lens:
        """A lens with OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6]], as many as there are.

        Args:
            K: intrinsics, pixels. width, height: image size.
            pixel_center: where its maker puts the centre of the top-left pixel: 0.5, or 0 for
                calibrations by OpenCV itself.
        """
        if len(distortion) not in (0, 4, 5, 8):
            raise ClipError(
                f"{len(distortion)} distortion coefficients; OpenCV's lenses have 0, 4, 5 or 8: "
                "k1 k2 p1 p2 [k3 [k4 k5 k6]]"
            )
        shift = 0.5 - pixel_center
        params = [K[0, 0], K[1, 1], K[0, 2] + shift, K[1, 2] + shift, *distortion]
        if any(distortion[4:]):
            model, count = "FULL_OPENCV", 12
        elif any(distortion):
            model, count = "OPENCV", 8
        else:
            model, count = "PINHOLE", 4
        params = [*params, *[0.0] * count][:count]
        return Lens(model, tuple(float(p) for p in params), width, height)

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Intrinsics of the pinhole camera with this focal length and principal point, float64."""
        lens = self._colmap
        return torch.tensor(
            [
                [lens.focal_length_x, 0, lens.principal_point_x],
                [0, lens.focal_length_y, lens.principal_point_y],
                [0, 0, 1],
            ],
            dtype=torch.float64,
        )

    def camera(self, world_to_camera: Float[np.ndarray, "4 4"], distorted: bool = False) -> Camera:
        """The pinhole camera that undistorted images belong to, float32.

        Args:
            distorted: that of the images as they are, with `optics`.
        """
        w2c = torch.from_numpy(np.asarray(world_to_camera, np.float64))
        optics = self.optics if distorted else None
        return Camera(self.K.float(), w2c.float(), self.width, self.height, optics)

    @property
    def optics(self) -> Optics | None:
        """What a camera with this lens has besides K; None for a pinhole.

        Raises:
            ClipError: a model that is not among OPTICS.
        """
        if self.model in PINHOLES:
            return None
        if self.model not in OPTICS:
            raise ClipError(
                f"a {self.model} lens cannot be drawn as it is, expected one of "
                f"{', '.join((*PINHOLES, *OPTICS))}; draw its pinhole (Lens.camera), for "
                "undistorted images"
            )
        model, radial, tangential = OPTICS[self.model]
        k, p = (tuple(self.params[i] for i in indices) for indices in (radial, tangential))
        return Optics(model, k, p)

    def resized(self, width: int, height: int) -> Lens:
        """The same lens behind an image of another size."""
        if (width, height) == (self.width, self.height):
            return self
        scaled = self._colmap  # a fresh one at each call
        scaled.rescale(width, height)
        return Lens(self.model, tuple(float(p) for p in scaled.params), width, height)

    def undistortion(
        self, size: tuple[int, int] | None = None, margins: Margins = (0, 0, 0, 0)
    ) -> Undistortion:
        """From this lens's images to those of `camera`; made once for equal lenses.

        Args:
            size: width and height of the images, if they were resized.
            margins: pixels by which those of `camera` are larger, as `margins` gives them.
        """
        if self.model in PINHOLES:  # captures with a focal length a frame stay cheap
            return Undistortion()
        return _undistortion(self, size or (self.width, self.height), margins)

    def margins(self, size: tuple[int, int]) -> Margins:
        """Pixels at each side by which the pinhole image has to be larger to show all that the
        lens shows; at most half of its width or height.

        Args:
            size: width and height of the images.
        """
        # not of the border alone, which may be 90 degrees off the axis, and beyond
        grid = np.stack(np.meshgrid(*(np.linspace(0, side, 201) for side in size)), -1)
        places = self.undistortion(size).pixels(grid)
        low, high = np.nanmin(places, (0, 1)), np.nanmax(places, (0, 1))
        beyond = np.clip([*-low, *(high - size)], 0, 0.5 * np.array([*size, *size]))
        left, top, right, bottom = np.ceil(beyond - 1e-3).astype(int).tolist()
        return left, top, right, bottom

    @property
    def _colmap(self) -> Any:
        from hoigs.core.system.colmap import pycolmap

        known = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
        if self.model not in known:
            raise ClipError(
                f"{self.model} is not a camera model of COLMAP{did_you_mean(self.model, known)}"
            )
        camera = pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )
        if not camera.focal_length_idxs():  # asked for its focal length, COLMAP ends the process
            raise ClipError(
                f"{self.model} has no focal length, so no pinhole image: take perspective pictures "
                "of the panorama first (COLMAP's examples: panorama_sfm.py)"
            )
        if not camera.verify_params():
            raise ClipError(
                f"{self.model} has the parameters {camera.params_info}; got {len(self.params)}"
            )
        return camera


@functools.lru_cache(maxsize=8)  # rigs have a few lenses; a map of 1280x720 pixels takes 7 MiB
def _undistortion(lens: Lens, size: tuple[int, int], margins: Margins) -> Undistortion:
    colmap = lens._colmap
    scale = np.array(size) / (lens.width, lens.height)
    focal = np.array([colmap.focal_length_x, colmap.focal_length_y]) * scale
    center = np.array([colmap.principal_point_x, colmap.principal_point_y]) * scale
    left, top, right, bottom = margins
    x, y = np.meshgrid(
        np.arange(-left, size[0] + right) + 0.5, np.arange(-top, size[1] + bottom) + 0.5
    )
    pinhole = np.stack((x, y), -1)
    flat = (pinhole.reshape(-1, 2) - center) / focal

    def seen(xy: np.ndarray) -> np.ndarray:
        rays = np.concatenate((xy, np.ones((len(xy), 1))), -1)
        return np.asarray(colmap.img_from_cam(rays), np.float64) * scale

    source = seen(flat)
    # beyond the radius where a polynomial turns back, it shows what it has shown already
    outward = ((seen(1.001 * flat) - source) / focal * flat).sum(-1)
    folded = (outward <= 0) & ((flat * flat).sum(-1) > 1e-6)
    source[folded] = np.nan
    source = source.reshape(*pinhole.shape)

    def forward(xy: np.ndarray) -> np.ndarray:
        points = xy.reshape(-1, 2).astype(np.float64)
        known = np.isfinite(points).all(-1)
        out = np.full_like(points, np.nan)
        if known.any():
            out[known] = np.asarray(colmap.cam_from_img(points[known] / scale))[:, :2]
            out[known] = out[known] * focal + center + (left, top)
        return out.reshape(xy.shape).astype(xy.dtype)

    found = Undistortion(source, forward, margins)
    return found if found.shift >= NEGLIGIBLE_SHIFT else Undistortion()
