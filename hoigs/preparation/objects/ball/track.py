"""A tracked ball: an image disc a frame, so a mask, a metric depth and a sphere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.core.files.npz import load_arrays
from hoigs.core.maths.series import fill_gaps, smooth
from hoigs.core.values.camera import Camera
from hoigs.core.values.undistortion import Undistortion
from hoigs.preparation.objects.ball.sphere import fit_cone, outline_rays
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError


@dataclass(frozen=True)
class BallTrack:
    """Discs of a ball in the frames given out.

    Attributes:
        centers: pixels, interpolated where the ball was not seen.
        radii: pixels, smoothed over time (a ball's distance changes slowly, its measured outline
            does not), interpolated likewise.
        observed: frames in which it was measured.
        jitter: spread of measured over smoothed radius, a fraction: the scale's uncertainty.
    """

    centers: Float[np.ndarray, "F 2"]
    radii: Float[np.ndarray, " F"]
    observed: Bool[np.ndarray, " F"]
    jitter: float

    def disc(self, frame: int, width: int, height: int) -> Bool[np.ndarray, "H W"]:
        """Pixels whose centre lies in the disc."""
        x = np.arange(width) + 0.5 - self.centers[frame, 0]
        y = np.arange(height) + 0.5 - self.centers[frame, 1]
        return x[None] ** 2 + y[:, None] ** 2 <= self.radii[frame] ** 2


def load_ball(path: Path, video: Frames, undistort: Undistortion) -> BallTrack:
    """ball_track.npz (`xyr` [F, 3], pixels of the video, NaN where unseen), at the frames' size.

    Raises:
        SourceError: another length than the video, or the ball is never seen.
    """
    try:
        xyr = load_arrays(path)["xyr"]
    except (ValueError, KeyError) as error:
        raise SourceError(f"{path}: expected an npz with xyr [F, 3]; {error}") from error
    if xyr.ndim != 2 or xyr.shape[1] != 3 or len(xyr) < video.total:
        raise SourceError(
            f"{path}: xyr has shape {list(xyr.shape)}, expected [{video.total}, 3]: one row a "
            "video frame, centre x, y and radius in pixels, NaN where the ball is not seen"
        )
    xyr = xyr[video.indices].astype(np.float64) * (video.width / video.native_width)
    xyr[:, :2] = undistort.pixels(xyr[:, :2])
    observed = np.isfinite(xyr).all(1) & (xyr[:, 2] > 0)
    if not observed.any():
        raise SourceError(f"{path}: the ball is seen in none of the {len(xyr)} chosen frames")
    return _track(xyr, observed)


def _track(xyr: Float[np.ndarray, "F 3"], observed: Bool[np.ndarray, " F"]) -> BallTrack:
    filled = fill_gaps(xyr, observed)
    radii = smooth(filled[:, 2])
    jitter = float(np.std(filled[observed, 2] / radii[observed]))
    return BallTrack(filled[:, :2], radii, observed, jitter)


def refine_ball(ball: BallTrack, frames: Iterable[UInt8[np.ndarray, "H W 3"]]) -> BallTrack:
    """The same track, each disc moved to the strongest round edge near it.

    Trackers give boxes or masks on a coarse grid; a ball's depth is as good as its radius, so a
    pixel matters. Centre and radius move by at most 12 % of the radius.

    Args:
        frames: the images of the track, undistorted.
    """
    xyr = np.concatenate((ball.centers, ball.radii[:, None]), 1)
    for i, image in enumerate(frames):
        if ball.observed[i]:
            xyr[i] = _round_edge(image, xyr[i])
    return _track(xyr, ball.observed)


_TURNS = np.linspace(0, 2 * np.pi, 64, endpoint=False)
_CIRCLE = np.stack((np.cos(_TURNS), np.sin(_TURNS)))


def _round_edge(
    image: UInt8[np.ndarray, "H W 3"], disc: Float[np.ndarray, " 3"], reach: float = 0.12
) -> Float[np.ndarray, " 3"]:
    """The circle near `disc` with the largest mean step of grey across it, coarse to fine."""
    x, y, r = disc
    pad = int(np.ceil(1.5 * r + 3))
    left, top = max(0, int(x) - pad), max(0, int(y) - pad)
    patch = image[top : int(y) + pad, left : int(x) + pad].astype(np.float32).mean(-1)
    if min(patch.shape) < 3:
        return disc
    band = max(1.0, r / 30)  # pixels inside and outside the edge that are compared
    grey = ndimage.gaussian_filter(patch, band)
    corner = np.array([left + 0.5, top + 0.5])
    steps = np.linspace(-1, 1, 5)
    moves = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    best = disc
    for size in (reach * r, reach * r / 3, reach * r / 9):
        tried = best + moves * size
        step = _ring(grey, tried, corner, -band) - _ring(grey, tried, corner, band)
        # one arc of high contrast must not outweigh the whole circle
        limit = 1.5 * np.median(np.abs(step).max(0))
        strength = np.abs(np.clip(step, -limit, limit).mean(-1))
        # of nearly equal edges the nearest to the tracker's
        away = (tried - disc) / (reach * r)
        best = tried[(strength * (1 - 0.05 * (away**2).sum(-1))).argmax()]
    return disc + np.clip(best - disc, -reach * r, reach * r)


def _ring(
    grey: Float[np.ndarray, "H W"],
    discs: Float[np.ndarray, "D 3"],
    corner: Float[np.ndarray, " 2"],
    outwards: float,
) -> Float[np.ndarray, "D A"]:
    """Grey levels on circles that are `outwards` pixels wider than the discs."""
    offsets = (discs[:, 2:] + outwards)[..., None] * _CIRCLE
    at = discs[:, :2, None] - corner[:, None] + offsets
    return ndimage.map_coordinates(grey, (at[:, 1], at[:, 0]), order=1, mode="nearest")


def ball_centers(ball: BallTrack, cameras: list[Camera], radius: float) -> Float[Tensor, "F 3"]:
    """Ball centres in the world, metres, from the apparent size of a sphere of known radius: where
    the cone of rays along the disc's edge touches it."""
    centers = []
    for camera, xy, r in zip(cameras, ball.centers, ball.radii, strict=True):
        axis, angle, _ = fit_cone(outline_rays(xy + r * _CIRCLE.T, camera))
        local = torch.from_numpy(radius / np.sin(angle) * axis).float()
        centers.append(camera.to_world(local))
    return torch.stack(centers)
