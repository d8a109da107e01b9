"""Optics: cameras that are no pinhole with a global shutter, and Gaussians through them.

**Points.** X = (x, y, z) is a point in camera coordinates, s = (x^2 + y^2) / z^2:

    ortho      (a, b) = (x, y)                                      K in pixels per metre
    pinhole    (a, b) = g (x, y) / z + (dx, dy),  g = (1 + k1 s + k2 s^2 + k3 s^3)
                                                      / (1 + k4 s + k5 s^2 + k6 s^3)
               dx = 2 p1 xy / z^2 + p2 (s + 2 x^2 / z^2) + s1 s + s2 s^2
               dy = p1 (s + 2 y^2 / z^2) + 2 p2 xy / z^2 + s3 s + s4 s^2
    fisheye    (a, b) = g (x, y) / z,  g = theta (1 + k1 theta^2 + ... + k4 theta^8) / sqrt(s),
               theta = atan(sqrt(s)), equidistant where all k are 0
    (u, v) = (fx a + cx, fy b + cy)

They are OpenCV's models, in COLMAP's names PINHOLE, OPENCV, FULL_OPENCV and OPENCV_FISHEYE. A point
has a place on the image where z > near, and sqrt(s) is within the radius up to which sqrt(s) g
grows (beyond it a polynomial turns back, and shows again what it has shown); see
`Optics.largest_slope`.

**Rolling shutter.** Each row of pixels (or column) is exposed at a time tau of its own, from 0 in
the first to 1 in the last; the pose turns by slerp and moves on a line between the two. A point is
at the place (u, v) that solves

    (u, v) = place of X(tau),  tau = clamp(a u + b v + c, 0, 1),
    X(tau) = Exp((tau - 1/2) w) R x + t + (tau - 1/2) d,  R, t of the middle, (w, d) the motion

by Newton's iteration, kept within [0, 1], from tau = 1/2 for the mean of a Gaussian (or a single
point) and from the mean's tau for its other six points:

    tau <- clamp(tau + (a u + b v + c - tau) / slope, 0, 1),  slope = 1 - d(a u + b v) / dtau

or with a slope of 1, as a fixed-point iteration, where the slope is not positive: where the point
moves along with the shutter, and faster. The iteration stops after a step of less than
SHUTTER_TOLERANCE of a row, whose error is of the order of its square. A point that has not stopped
after SHUTTER_ITERATIONS steps has no place: it moves about as fast as the shutter, which sees it in
many rows or in none. Gradients are those of the implicit function theorem. Depth, `near` and the
direction of view are those of the pose in the middle.

**Gaussians.** The unscented transform of 3DGUT (Wu et al., CVPR 2025, arXiv:2412.12507), with
gsplat's parameters alpha = 0.1, beta = 2, kappa = 0 (Wan and van der Merwe 2000). With
h = alpha sqrt(3 + kappa), the standard deviations e_k along the axes, p the places of the mean and
of mean +- h e_k, and d_k+- their differences from the first:

    G_k = (d_k+ - d_k-) / 2h,  S_k = (d_k+ + d_k-) / 2h,  shift = sum_k S_k / h
    mean = p + shift,  covariance = sum_k (G_k G_k^T + S_k S_k^T) + (beta - alpha^2) shift shift^T

which are the weighted sums of the transform, without their weights of -99 and 16.7, that cancel.
A row is culled where one of the seven points has no place. All is computed in float64, since
differences over h standard deviations leave float32 too few digits.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import forward_ad

from hoigs.core.errors import CameraError, did_you_mean
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle

Model = Literal["pinhole", "ortho", "fisheye"]
Shutter = Literal["global", "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left"]
MODELS = get_args(Model)
COEFFICIENTS = {"pinhole": (6, 2, 4), "ortho": (0, 0, 0), "fisheye": (4, 0, 0)}

ALPHA, BETA, KAPPA = 0.1, 2.0, 0.0
STEP = ALPHA * math.sqrt(3.0 + KAPPA)  # standard deviations from the mean to the other six points
BEND = BETA - ALPHA * ALPHA  # weight of the shift in the covariance
SHUTTER_ITERATIONS = 10  # at most; two or three are taken where a frame moves by a tenth
SHUTTER_TOLERANCE = 0.01  # rows
SMALL_SLOPE = 1e-4  # of s, below which the arctangent is a series


@dataclass(frozen=True)
class Optics:
    """What makes a `Camera` another than a pinhole with a global shutter.

    A plain `Optics()` is a pinhole whose Gaussians are projected by the unscented transform.

    Attributes:
        model: "pinhole", "ortho" (K is in pixels per metre) or "fisheye" (sees less than 180
            degrees).
        radial: OpenCV's k1 to k6 (pinhole) or k1 to k4 (fisheye); the rest are 0.
        tangential: p1, p2. thin_prism: s1 to s4; of a pinhole only.
        shutter: which row or column of pixels is exposed first.
        last_world_to_camera: pose while the last one is exposed, as `Camera.world_to_camera` is
            while the first one is; None with a global shutter.

    Raises:
        CameraError: no such model or shutter, coefficients that it does not have, or a shutter
            without its last pose.
    """

    model: Model = "pinhole"
    radial: tuple[float, ...] = ()
    tangential: tuple[float, ...] = ()
    thin_prism: tuple[float, ...] = ()
    shutter: Shutter = "global"
    last_world_to_camera: Float[Tensor, "4 4"] | None = None

    def __post_init__(self) -> None:
        for name, known in (("model", get_args(Model)), ("shutter", get_args(Shutter))):
            given = getattr(self, name)
            if given not in known:
                raise CameraError(
                    f"Optics.{name} is {given!r}, expected one of {', '.join(known)}"
                    f"{did_you_mean(str(given), known)}"
                )
        for name, most in zip(("radial", "tangential", "thin_prism"), COEFFICIENTS[self.model]):
            given = getattr(self, name)
            if len(given) > most or not all(map(math.isfinite, given)):
                raise CameraError(
                    f"Optics.{name} is {given}, expected at most {most} finite numbers for "
                    f"{self.model!r}"
                )
            object.__setattr__(self, name, tuple(map(float, given)))
        pose = self.last_world_to_camera
        if (self.shutter == "global") != (pose is None):
            raise CameraError(
                f"Optics.shutter is {self.shutter!r} and last_world_to_camera is "
                f"{'not ' * (pose is not None)}None; a rolling shutter needs both"
            )
        if pose is not None and tuple(pose.shape) != (4, 4):
            raise CameraError(
                f"Optics.last_world_to_camera has shape {list(pose.shape)}, expected [4, 4]"
            )

    @property
    def needs(self) -> frozenset[str]:
        """What a rasterizer has to be able to draw: names of `Capabilities.optics`."""
        names: set[str] = set()
        if self.model != "pinhole":
            names.add(self.model)
        if any((*self.radial, *self.tangential, *self.thin_prism)):
            names.add("distortion")
        if self.shutter != "global":
            names.add("rolling_shutter")
        return frozenset(names or {"unscented"})

    @property
    def coefficients(self) -> tuple[float, ...]:
        """k1 to k6, p1, p2, s1 to s4: twelve numbers."""
        parts = ((self.radial, 6), (self.tangential, 2), (self.thin_prism, 4))
        return tuple(x for part, count in parts for x in (*part, *(0.0,) * (count - len(part))))

    @property
    def largest_slope(self) -> float:
        """s up to which points have a place on the image; infinite where nothing turns back."""
        return _largest_slope(self.model, self.radial)

    def row_time(self, width: int, height: int) -> tuple[float, float, float]:
        """a, b, c of the time a u + b v + c at which a pixel is exposed."""
        across = self.shutter in ("left_to_right", "right_to_left")
        last = max((width if across else height) - 1, 1)
        slope, start = 1.0 / last, -0.5 / last
        if self.shutter in ("bottom_to_top", "right_to_left"):
            slope, start = -slope, 1.0 - start
        return (slope, 0.0, start) if across else (0.0, slope, start)

    def middle(
        self, world_to_camera: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "4 4"], Float[Tensor, " 6"] | None]:
        """The pose in the middle of the exposure, and the motion (w, d) from its start to its end.

        As the module's head uses them: w is axis-angle, radians; d is in metres.
        """
        last = self.last_world_to_camera
        if last is None:
            return world_to_camera, None
        first = world_to_camera
        turn = matrices_to_axis_angle(last[:3, :3].to(first) @ first[:3, :3].mT)
        shift = last[:3, 3].to(first) - first[:3, 3]
        R: Float[Tensor, "3 3"] = axis_angle_to_matrices(0.5 * turn) @ first[:3, :3]
        top = torch.cat((R, (first[:3, 3] + 0.5 * shift)[:, None]), 1)
        return torch.cat((top, first[3:]), 0), torch.cat((turn, shift))

    def map_pose(self, change: Any) -> Optics:
        """With `change` of the last pose, where there is one."""
        pose = self.last_world_to_camera
        return self if pose is None else replace(self, last_world_to_camera=change(pose))


@functools.lru_cache(maxsize=64)
def _largest_slope(model: str, radial: tuple[float, ...]) -> float:
    k = np.array([*radial, *[0.0] * (6 - len(radial))])
    if model == "fisheye":
        squared = _smallest_root([1.0, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])  # of theta^2
        return math.tan(math.sqrt(squared)) ** 2 if squared < (math.pi / 2) ** 2 else math.inf
    if model == "ortho":
        return math.inf
    above, below = np.array([1.0, *k[:3]]), np.array([1.0, *k[3:]])
    order = np.arange(4)
    # the numerator of the derivative of sqrt(s) above(s) / below(s) by sqrt(s)
    growth = np.convolve(above + 2 * order * above, below) - np.convolve(above, 2 * order * below)
    return min(_smallest_root(growth), _smallest_root(below))


def _smallest_root(polynomial: Sequence[float] | np.ndarray) -> float:
    """The smallest positive root, coefficients in rising order; infinity without any."""
    roots = np.roots(np.trim_zeros(np.asarray(polynomial, np.float64), "b")[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min()) if len(real) else math.inf


def image_points(
    points: Float[Tensor, "*batch 3"], K: Float[Tensor, "3 3"], optics: Optics
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Places of points in camera coordinates, and which are within the valid radius.

    Differentiable, in the image centre too. Points that are not in front of the camera have no
    place: what is returned for them is finite and means nothing.
    """
    focal, principal = torch.stack((K[0, 0], K[1, 1])), K[:2, 2]
    xy, z = points[..., :2], points[..., 2:]
    if optics.model == "ortho":
        return xy * focal + principal, torch.ones_like(points[..., 0], dtype=torch.bool)
    slopes = xy / torch.where(z > 0, z, 1.0)
    s = (slopes * slopes).sum(-1, keepdim=True)
    valid = s[..., 0] <= optics.largest_slope
    k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4 = optics.coefficients
    if optics.model == "fisheye":
        arc = _arc(s)
        w = arc * arc * s
        gain = arc * (1.0 + w * (k1 + w * (k2 + w * (k3 + w * k4))))
        return slopes * gain * focal + principal, valid
    gain = (1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6)))
    x, y = slopes.unbind(-1)
    r = s[..., 0]
    dx = 2 * p1 * x * y + p2 * (r + 2 * x * x) + r * (s1 + s2 * r)
    dy = p1 * (r + 2 * y * y) + 2 * p2 * x * y + r * (s3 + s4 * r)
    return (slopes * gain + torch.stack((dx, dy), -1)) * focal + principal, valid


def _arc(s: Tensor) -> Tensor:
    """atan(sqrt(s)) / sqrt(s), smooth at zero."""
    small = s < SMALL_SLOPE
    root = torch.where(small, 1.0, s).sqrt()
    series = 1.0 + s * (-1 / 3 + s * (1 / 5 + s * (-1 / 7 + s / 9)))
    return torch.where(small, series, torch.atan(root) / root)


def world_points_on_image(
    points: Float[Tensor, "*batch 3"],
    world_to_camera: Float[Tensor, "4 4"],
    motion: Float[Tensor, " 6"] | None,
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    optics: Optics,
    near: float = 0.0,
    start: Float[Tensor, "*#batch 1"] | float = 0.5,
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"], Float[Tensor, "*#batch 1"] | float]:
    """Places of world points, which have one by the rules at the head of this module, and when.

    Args:
        world_to_camera, motion: as `Optics.middle` gives them. size: width and height, pixels.
        start: time in [0, 1] from which the iteration for a rolling shutter starts.

    Returns:
        Pixels, with gradients; which points have a place; the time in [0, 1] at which each is seen
        by a rolling shutter, without gradients. With a global shutter the time is `start`.
    """
    turned = points @ world_to_camera[:3, :3].mT
    if motion is None:
        moved = turned + world_to_camera[:3, 3]
        places, valid = image_points(moved, K, optics)
        return places, valid & (moved[..., 2] > near), start
    *row, c = optics.row_time(*size)
    down = points.new_tensor(row)[:, None]

    def seen_at(time: Tensor, turned: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Places, which have one, their change with time, and the next time before its clamp."""
        since = time - 0.5
        turned = (axis_angle_to_matrices(since * motion[:3]) @ turned[..., None])[..., 0]
        moved = turned + world_to_camera[:3, 3] + since * motion[3:]
        velocity = torch.linalg.cross(motion[:3].expand_as(turned), turned) + motion[3:]
        with forward_ad.dual_level():
            places, valid = image_points(forward_ad.make_dual(moved, velocity), K, optics)
            places, change = forward_ad.unpack_dual(places)
        change = change.detach()
        slope = 1.0 - change @ down
        ahead = (places @ down + c - time) / torch.where(slope > 0, slope, 1.0)
        return places, valid & (moved[..., 2] > near), change, time + ahead

    # forward differentiation knows no inference mode
    with torch.inference_mode(False):
        with torch.no_grad():
            rows = turned.reshape(-1, 3)
            time = rows.new_empty(*turned.shape[:-1], 1).copy_(torch.as_tensor(start))
            times, left = time.view(-1, 1), torch.arange(len(rows), device=rows.device)
            for _ in range(SHUTTER_ITERATIONS):
                before = times[left]
                times[left] = after = seen_at(before, rows[left])[3].clamp(0.0, 1.0)
                still = (after - before).abs() < SHUTTER_TOLERANCE * abs(down).max()
                left = left[~still[:, 0]]
                if not len(left):
                    break
            found = torch.ones_like(times[:, 0], dtype=torch.bool)
            found[left] = False
        places, valid, change, ahead = seen_at(time, turned)
    ahead = torch.where((ahead >= 0) & (ahead <= 1), ahead - time, 0.0)
    return places + change * ahead, valid & found.view_as(valid), time


def unscented(
    means: Float[Tensor, "M 3"],
    axes: Float[Tensor, "M 3 3"],
    world_to_camera: Float[Tensor, "4 4"],
    motion: Float[Tensor, " 6"] | None,
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    optics: Optics,
    near: float,
) -> tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2 7"], Bool[Tensor, " M"]]:
    """Means on the image, a square root of the covariances there, and which rows have a place.

    Args:
        axes: columns are the standard deviations along the axes, world, metres.
    """
    around = STEP * axes.mT
    points = means[:, None] + torch.cat((around, -around), 1)
    camera = (world_to_camera, motion, K, size, optics, near)
    centre, seen, time = world_points_on_image(means[:, None], *camera)
    places, all_seen = world_points_on_image(points, *camera, time)[:2]
    plus, minus = (places - centre).split(3, 1)
    first, second = (plus - minus) / (2 * STEP), (plus + minus) / (2 * STEP)
    shift = second.sum(1) / STEP
    root = torch.cat((first, second, math.sqrt(BEND) * shift[:, None]), 1).mT
    return centre[:, 0] + shift, root, seen[:, 0] & all_seen.all(-1)
