"""A tracked ball: an image disc a frame, so a mask, a metric depth and a sphere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.maths.frame_times import fill_gaps, smooth
from hoigs.core.system.npz import load_arrays
from hoigs.core.values.camera import Camera, pinhole_rays
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.mask_stack import MaskStack, outlines_of
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError

# A ball known by its masks alone: round in every frame, so a sphere of one radius.
#
# The rays that touch a sphere form a circular cone about the direction of its centre; its outline
# in the image is an ellipse, whose middle is not the centre's image. So a cone is fitted to the
# rays of the outline, and not a circle to its pixels.

LIMBS = (7, 8, 10, 11, 15, LEFT_WRIST, RIGHT_WRIST)  # ankles, feet, head, wrists
ROUND, MOSTLY = 0.05, 0.12  # off a circle, of its radius: median of the frames, and 80 % of them
RASTER = 0.35  # pixels that a mask's outline is off by, for its pixels alone
RIM = 2  # pixels: half the width of a limb that may hide it
SMALLEST = 3.0  # pixels of the radius, median
FEWEST, FEWEST_EDGES = 8, 12  # frames; edges of pixels along the outline
SPILLS = 0.5  # of the ball's part that nothing hides, to lie outside its mask
SHOWN, ENOUGH = 0.6, 0.35  # of the circle: to judge by it; to find the centre by it
SECTORS = 20  # of a circle
TOUCHES = 0.09  # metres in the image from a joint to the ball's outline, at the joint's distance
ALONG = (0.25, 0.5, 0.75, 1.0)  # of a bone, where it is looked at
FLESH = 0.05  # metres about a bone
WITHIN, CLEAR = 0.7, 0.2  # of the disc's radius, that hides bones; share of frames that may differ


@dataclass(frozen=True)
class Cones:
    """Cones of rays that touch a ball, about its centre's direction.

    Attributes:
        directions: unit, camera axes; interpolated where not observed.
        angles: half the opening, radians, smoothed: a ball's distance changes slowly.
        observed: frames in which the outline gave the direction.
        off: of each frame, the outline from the cone, of its angle, without what the raster of
            pixels explains; NaN where it is not seen.
        jitter: spread of measured over smoothed angles.
    """

    directions: Float[np.ndarray, "F 3"]
    angles: Float[np.ndarray, " F"]
    observed: Bool[np.ndarray, " F"]
    off: Float[np.ndarray, " F"]
    jitter: float

    @property
    def judged(self) -> Float[np.ndarray, " N"]:
        """`off` of the frames that show enough."""
        return self.off[np.isfinite(self.off)]

    def places(self, cameras: Sequence[Camera], radius: float) -> Float[Tensor, "F 3"]:
        """Centres in the world, metres, of a sphere of `radius`."""
        away = radius / np.sin(self.angles)
        local = torch.from_numpy(self.directions * away[:, None]).float()
        return torch.stack([c.to_world(p) for c, p in zip(cameras, local, strict=True)])


class NoBallError(Exception):
    """Why masks are not those of a ball."""


def ball_cones(masks: MaskStack, humans: MaskStack, cameras: Sequence[Camera]) -> Cones:
    """The cone of every frame; by the part of the outline that does not border on the person where
    the whole is not round.

    Raises:
        NoBallError: the outline is too small, or seen too little, to fit any.
    """
    seen = outlines_of(masks).observed
    count = len(masks)
    found, off = np.full((count, 4), np.nan), np.full(count, np.nan)
    rays = [np.zeros((0, 3))] * count
    for i in np.flatnonzero(seen).tolist():
        focal = float(cameras[i].focal.mean())
        xy, free = _outline(masks[i], humans[i])
        if len(xy) < FEWEST_EDGES:
            continue
        rays[i] = outline_rays(xy, cameras[i])
        direction, angle, residual = fit_cone(rays[i])
        off[i] = _off(residual, angle, focal)
        if off[i] > ROUND and free.sum() >= max(ENOUGH * len(xy), FEWEST_EDGES):
            rays[i] = rays[i][free]  # the person hides a part of it
            direction, angle, residual = fit_cone(rays[i])
            if free.mean() >= SHOWN:
                off[i] = _off(residual, angle, focal)
        spilled = _spilled(direction, angle, masks[i], humans[i], cameras[i])
        if spilled > SPILLS:  # the side of something long is a part of a circle that is much larger
            off[i] = spilled
        if off[i] <= 2 * MOSTLY and angle < 1:
            found[i] = *direction, angle
        if off[i] <= MOSTLY and _around(rays[i], direction) < SHOWN:
            off[i] = np.nan  # an arc, such as the border of the picture leaves, proves no circle
    known = np.isfinite(found[:, 3])
    if int(known.sum()) < FEWEST:
        raise NoBallError(f"{int(known.sum())} frames show it round, and {FEWEST} are needed")
    angles = np.exp(smooth(fill_gaps(np.log(found[:, 3]), known)))
    jitter = float(np.std(found[known, 3] / angles[known]))
    for i in np.flatnonzero(known).tolist():  # the centre again, now for the smoothed angle
        found[i, :3] = fit_cone(rays[i], angles[i])[0]
    directions = fill_gaps(found[:, :3], known)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return Cones(directions, angles, known, off, jitter)


def require_round(cones: Cones, cameras: Sequence[Camera]) -> None:
    """NoBallError where the outlines are not all circles, which says what they are."""
    focal = float(np.median([float(c.focal.mean()) for c in cameras]))
    across = float(np.median(cones.angles)) * focal
    if len(cones.judged) < FEWEST:
        raise NoBallError(
            f"{len(cones.judged)} frames show most of its circle, and {FEWEST} are needed"
        )
    median, most = np.median(cones.judged), np.quantile(cones.judged, 0.8)
    if across < SMALLEST:
        raise NoBallError(f"it is {2 * across:.0f} pixels across")
    if median > ROUND or most > MOSTLY:
        raise NoBallError(f"its outline is {100 * median:.0f} % off a circle")


def contact_radius(
    cones: Cones, joints: Float[Tensor, "F J 3"], cameras: Sequence[Camera]
) -> tuple[float, int, float] | None:
    """Metres of the radius that puts the ball as far off as the hand, foot or head at it.

    Returns:
        the median over frames, the number of frames, and their spread (half of the middle 68 %),
        relative; None where no limb comes near the ball in the image.
    """
    found = []
    for i, camera in enumerate(cameras):
        if not cones.observed[i]:
            continue
        local = camera.to_camera(joints[i][list(LIMBS)]).double().numpy()
        away = np.linalg.norm(local, axis=-1)
        angle = np.arccos(np.clip(local @ cones.directions[i] / away, -1, 1))
        gap = (angle - cones.angles[i]) * away
        nearest = int(np.abs(gap).argmin())
        if abs(gap[nearest]) < TOUCHES:
            found.append(away[nearest] * np.sin(cones.angles[i]))
    if not found:
        return None
    low, middle, high = np.quantile(found, (0.16, 0.5, 0.84))
    return float(middle), len(found), float((high - low) / 2 / middle)


def clear_radius(
    cones: Cones,
    masks: MaskStack,
    joints: Float[Tensor, "F J 3"],
    parents: Sequence[int],
    cameras: Sequence[Camera],
) -> tuple[float, int] | None:
    """Metres of the largest radius with which the ball stays in front of the bones that it hides.

    Where a bone's image lies in the ball's mask, the ball is before it; a larger ball would lie
    farther off, in the limb or behind it.

    Args:
        masks: of the ball. joints: world, metres. parents: of the joints, -1 for the root.

    Returns:
        the radius that keeps clear in four of five frames, and the number of frames; None where
        too few show the ball before a limb.
    """
    starts, found = list(parents[1:]), []
    for i, camera in enumerate(cameras):
        if not cones.observed[i]:
            continue
        bones = torch.cat([t * joints[i, 1:] + (1 - t) * joints[i, starts] for t in ALONG])
        pixels, depth = camera.project(bones)
        x, y = pixels[camera.shows(pixels, depth)].long().T
        shown = bones[camera.shows(pixels, depth)][torch.from_numpy(masks[i])[y, x]]
        local = camera.to_camera(shown).double().numpy()
        away = np.linalg.norm(local, axis=-1)
        angle = np.arccos(np.clip(local @ cones.directions[i] / away, -1, 1))
        hidden = away[angle < WITHIN * cones.angles[i]]
        if len(hidden):
            found.append((hidden.min() - FLESH) / (1 / np.sin(cones.angles[i]) + 1))
    return (float(np.quantile(found, CLEAR)), len(found)) if len(found) >= FEWEST else None


def fit_cone(
    rays: Float[np.ndarray, "N 3"], angle: float | None = None
) -> tuple[Float[np.ndarray, " 3"], float, Float[np.ndarray, " N"]]:
    """The cone nearest to unit rays, by Gauss-Newton on their angles to its axis; rays far off,
    such as those along what hides a part of it, count less (Cauchy weights).

    Args:
        angle: of the cone, radians; None finds it, too.

    Returns:
        axis, angle, and the rays' angles minus the cone's
    """
    axis = rays.mean(0)
    axis /= np.linalg.norm(axis)
    fixed, known = angle is not None, angle
    off = _angles(rays, axis)
    width = float(known if known is not None else off.mean())
    for _ in range(20):
        away = _angles(rays, axis)
        off = away - width
        scale = max(1e-6, 2 * float(np.median(np.abs(off))))
        weight = 1 / (1 + (off / scale) ** 2)
        tangents = rays - (rays @ axis)[:, None] * axis
        tangents /= np.maximum(np.linalg.norm(tangents, axis=-1, keepdims=True), 1e-9)
        basis = np.linalg.svd(axis[None])[2][1:]
        columns = [*(-(tangents @ basis.T)).T, *(() if fixed else (-np.ones(len(rays)),))]
        matrix = np.stack(columns, 1) * weight[:, None]
        step = np.linalg.lstsq(matrix, -off * weight, rcond=None)[0]
        axis = axis + step[:2] @ basis
        axis /= np.linalg.norm(axis)
        if not fixed:
            width = max(1e-6, width + float(step[2]))
    return axis, width, _angles(rays, axis) - width


def _angles(rays: Float[np.ndarray, "N 3"], axis: Float[np.ndarray, " 3"]) -> np.ndarray:
    """Small ones stay exact, unlike those of arccos."""
    return np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=-1), rays @ axis)


def _around(rays: Float[np.ndarray, "N 3"], axis: Float[np.ndarray, " 3"]) -> float:
    """The share of a circle about an axis that has rays."""
    u, v = (rays @ np.linalg.svd(axis[None])[2][1:].T).T
    sectors = np.floor((np.arctan2(v, u) / (2 * np.pi) + 0.5) * SECTORS).astype(int)
    return len(np.unique(sectors % SECTORS)) / SECTORS


def outline_rays(xy: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 3"]:
    """Unit rays of pixels, camera axes."""
    flat = pinhole_rays(camera.K.double(), torch.from_numpy(xy)).numpy()
    rays = np.concatenate((flat, np.ones((len(flat), 1))), -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _outline(
    mask: Bool[np.ndarray, "H W"], human: Bool[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, " N"]]:
    """Middles of the edges of the mask's pixels, without those of the image's border; and which
    of them the person does not border on."""
    labels, parts = ndimage.label(mask)
    if parts > 1:
        mask = labels == 1 + np.bincount(labels[labels > 0])[1:].argmax()
    # a thin rim of the ball that was taken for the person hides nothing
    hides = ndimage.binary_opening(human & ~mask, iterations=RIM)
    hides = np.pad(ndimage.binary_dilation(hides, iterations=1), 1)
    own, back = np.pad(mask, 1), np.pad(~mask, 1)
    points, free = [], []
    for rows, columns in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        shift = (-rows, -columns)
        y, x = np.nonzero(own & np.roll(back, shift, (0, 1)))
        points.append(np.stack((x - 0.5 + columns / 2, y - 0.5 + rows / 2), -1))
        free.append(~np.roll(hides, shift, (0, 1))[y, x])
    return np.concatenate(points), np.concatenate(free)


def _spilled(
    axis: Float[np.ndarray, " 3"],
    angle: float,
    mask: Bool[np.ndarray, "H W"],
    human: Bool[np.ndarray, "H W"],
    camera: Camera,
) -> float:
    """The share of a cone's pixels about the mask, and beside the person, that it does not have."""
    ((top, bottom), (left, right)) = [
        (max(0, int(at.min() - np.ptp(at))), int(at.max() + np.ptp(at)) + 1)
        for at in np.nonzero(mask)
    ]
    y, x = np.nonzero(~human[top:bottom, left:right])
    y, x = y + top, x + left
    rays = outline_rays(np.stack((x + 0.5, y + 0.5), -1), camera)
    inside = rays @ axis > np.cos(min(angle, np.pi))
    return float((~mask[y[inside], x[inside]]).mean()) if inside.any() else 1.0


def _off(residual: Float[np.ndarray, " N"], angle: float, focal: float) -> float:
    """Root mean square residual over the angle, without the raster's part."""
    return float(np.sqrt(max(0.0, float((residual**2).mean()) - (RASTER / focal) ** 2)) / angle)


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
