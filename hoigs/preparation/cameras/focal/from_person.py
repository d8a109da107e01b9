"""A still camera's focal length from the person in view: perspective-n-point with one unknown f.

Landmarks that are known in space determine how large near parts of the person look against far
ones. That is a weak cue: it is used only where the reprojection error has a clear minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

SHORTEST, LONGEST, TRIED = 0.5, 2.0, 29  # focal lengths, in longer sides of the image; 5 % apart
FRAMES = 60  # looked at, spread over the video
ENOUGH_LANDMARKS, ENOUGH_FRAMES = 12, 5
OUTLIER = 0.008  # of the longer side: a miss at which a landmark begins to count less
STEPS = 12  # of Levenberg-Marquardt
FLAT = 1.05  # errors within this factor of the smallest are as good
AGREEING = 1.05  # factor by which halves of the video may lie beyond those
WIDEST = 1.35  # of the longest over the shortest that are as good, for a focal length to be known


@dataclass(frozen=True)
class FocalCurve:
    """How well each focal length explains the person's landmarks.

    Attributes:
        focals: tried, in longer sides of the image. errors: robust root mean square reprojection
            error of each, in the pixels that came in.
        halves: the best focal length for each half of the frames, in time.
    """

    focals: Float[np.ndarray, " G"]
    errors: Float[np.ndarray, " G"]
    halves: tuple[float, float]

    @property
    def best(self) -> float:
        """Where the error is least, in longer sides."""
        return _minimum(self.focals, self.errors)

    @property
    def range(self) -> tuple[float, float]:
        """Shortest and longest focal length whose error is within 5 % of the least."""
        limit = FLAT * self.errors.min()
        good = np.flatnonzero(self.errors <= limit)
        low = self._crossing(good[0], good[0] - 1, limit)
        high = self._crossing(good[-1], good[-1] + 1, limit)
        return min(low, self.best), max(high, self.best)

    def _crossing(self, inside: np.intp, outside: np.intp, limit: float) -> float:
        """Where the error reaches `limit` between two neighbours; at an end of all, that end."""
        if not 0 <= outside < len(self.focals):
            return float(self.focals[inside])
        a, b = self.errors[inside], self.errors[outside]
        share = (limit - a) / (b - a)
        return float(self.focals[inside] + share * (self.focals[outside] - self.focals[inside]))

    @property
    def distinct(self) -> bool:
        """Whether the minimum can be trusted: narrow, within what was tried, and twice the same."""
        low, high = self.range
        inside = self.focals[0] < low and high < self.focals[-1]
        agree = all(low / AGREEING <= half <= high * AGREEING for half in self.halves)
        return bool(inside and agree and high / low <= WIDEST)


def focal_curve(
    image: Float[np.ndarray, "F L 3"],
    world: Float[np.ndarray, "F L 3"],
    size: tuple[int, int],
) -> FocalCurve | None:
    """Reprojection error against focal length, the pose of every frame being fitted for each.

    The pose in each frame is a rotation and a translation of its landmarks in space (Levenberg-
    Marquardt, Geman-McClure errors); the optical axis goes through the image's middle.

    Args:
        image: x, y in pixels and visibility; NaN where not found. world: metres, along about the
            camera's axes; NaN where not known. size: width and height of the image.

    Returns:
        None with fewer than five frames of twelve landmarks that are known in both.
    """
    longer = max(size)
    known = np.isfinite(image).all(-1) & np.isfinite(world).all(-1)
    rows = np.flatnonzero(known.sum(1) >= ENOUGH_LANDMARKS)
    if len(rows) < ENOUGH_FRAMES:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, FRAMES).round().astype(int))]
    known = known[rows]
    pixels = np.where(known[..., None], image[rows][..., :2] - np.array(size) / 2, 0.0) / longer
    weights = np.where(known, image[rows][..., 2], 0.0)
    points = np.where(known[..., None], world[rows], 0.0)
    focals = np.geomspace(SHORTEST, LONGEST, TRIED)
    costs = np.stack([pose_costs(f, points, pixels, weights) for f in focals])  # [G, F]
    half = len(rows) // 2
    curves = [_errors(costs[:, part], weights[part]) for part in (slice(half), slice(half, None))]
    errors = _errors(costs, weights) * longer
    return FocalCurve(
        focals, errors, (_minimum(focals, curves[0]), _minimum(focals, curves[1]))
    )  # fmt: skip


def _errors(
    costs: Float[np.ndarray, "G F"], weights: Float[np.ndarray, "F L"]
) -> Float[np.ndarray, " G"]:
    return np.sqrt(costs.sum(1) / weights.sum())


def _minimum(focals: Float[np.ndarray, " G"], errors: Float[np.ndarray, " G"]) -> float:
    """Where a parabola through the least error and its neighbours is least."""
    i = int(errors.argmin())
    if i in (0, len(focals) - 1):
        return float(focals[i])
    a, b, c = errors[i - 1 : i + 2]
    shift = 0.5 * (a - c) / max(a - 2 * b + c, 1e-12)
    return float(focals[i] * (focals[i + 1] / focals[i]) ** shift)


def pose_costs(
    focal: float,
    points: Float[np.ndarray, "F L 3"],
    pixels: Float[np.ndarray, "F L 2"],
    weights: Float[np.ndarray, "F L"],
) -> Float[np.ndarray, " F"]:
    """Sum of robust squared errors of each frame at its best pose, in squared units of `pixels`.

    Args:
        pixels: from the principal point, in any unit, that of `focal`.
    """
    turned, place = points.copy(), _place(focal, points, pixels, weights)
    cost, slope, curvature = _linearised(focal, turned, place, pixels, weights)
    damping = np.full(len(points), 1e-3)
    for _ in range(STEPS):
        scaled = np.einsum("fii->fi", curvature) * damping[:, None] + 1e-12
        step = -np.linalg.solve(curvature + np.eye(6) * scaled[:, None], slope[..., None])[..., 0]
        new_turned = turned @ _rotations(step[:, 3:]).transpose(0, 2, 1)
        new_place = place + step[:, :3]
        found = _linearised(focal, new_turned, new_place, pixels, weights)
        better = found[0] < cost
        turned = np.where(better[:, None, None], new_turned, turned)
        place = np.where(better[:, None], new_place, place)
        cost = np.where(better, found[0], cost)
        slope = np.where(better[:, None], found[1], slope)
        curvature = np.where(better[:, None, None], found[2], curvature)
        damping = np.where(better, damping / 5, damping * 5).clip(1e-9, 1e6)
    return cost


def _linearised(
    focal: float,
    turned: Float[np.ndarray, "F L 3"],
    place: Float[np.ndarray, "F 3"],
    pixels: Float[np.ndarray, "F L 2"],
    weights: Float[np.ndarray, "F L"],
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F 6"], Float[np.ndarray, "F 6 6"]]:
    """Cost, its slope and Gauss-Newton curvature along translations and turns about the origin."""
    seen = turned + place[:, None]
    z = seen[..., 2].clip(0.1)
    xy = seen[..., :2] / z[..., None]
    off = focal * xy - pixels
    squared = np.square(off).sum(-1)
    soft = OUTLIER**2 / (OUTLIER**2 + squared)
    cost = (weights * soft * squared).sum(1)
    zero = np.zeros_like(z)
    along = (focal / z)[..., None, None] * np.stack(
        (np.stack((zero + 1, zero, -xy[..., 0]), -1), np.stack((zero, zero + 1, -xy[..., 1]), -1)),
        -2,
    )  # d pixel / d point, [F, L, 2, 3]
    x, y, w = np.moveaxis(turned, -1, 0)
    cross = np.stack((zero, w, -y, -w, zero, x, y, -x, zero), -1).reshape(*z.shape, 3, 3)
    jacobian = np.concatenate((along, along @ cross), -1)  # turning by a moves a point by a x p
    weighted = (weights * soft**2)[..., None, None] * jacobian
    slope = np.einsum("flki,flk->fi", weighted, off)
    return cost, slope, np.einsum("flki,flkj->fij", weighted, jacobian)


def _rotations(angles: Float[np.ndarray, "F 3"]) -> Float[np.ndarray, "F 3 3"]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(angles).as_matrix()


def _place(
    focal: float,
    points: Float[np.ndarray, "F L 3"],
    pixels: Float[np.ndarray, "F L 2"],
    weights: Float[np.ndarray, "F L"],
) -> Float[np.ndarray, "F 3"]:
    """Positions by linear least squares, as `placing.place` finds them, without turning."""
    ray = pixels / focal
    right = ray * points[..., 2:] - points[..., :2]
    w = weights[..., None]
    total = w.sum(1)
    mean_ray, mean_right = (w * ray).sum(1) / total, (w * right).sum(1) / total
    off_ray, off_right = ray - mean_ray[:, None], right - mean_right[:, None]
    z = -(w * off_ray * off_right).sum((1, 2)) / (w * off_ray**2).sum((1, 2)).clip(1e-12)
    z = z.clip(0.5)[:, None]
    return np.concatenate((mean_ray * z + mean_right, z), -1)
