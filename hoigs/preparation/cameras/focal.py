"""Which focal length a still camera gets: the given one, the file's, the person's, a usual one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.cameras.camera_track import ASSUMED_FOCAL
from hoigs.preparation.video.container import open_video
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import numbered_frames

USUAL = (0.6, 1.2)  # longer sides: main cameras of phones, and webcams, 45 to 80 degrees wide

# A still camera's focal length from the person in view: perspective-n-point with one unknown f.
#
# Landmarks that are known in space determine how large near parts of the person look against far
# ones. That is a weak cue: it is used only where the reprojection error has a clear minimum.

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


# The focal length that a video's container, or a photo's EXIF, gives.


# phones that give it give the equivalent on 35 mm film, whose picture is 43.27 mm across: Apple's
# QuickTime key, and EXIF's name for the same
SUFFIXES = ("focal_length.35mm_equivalent", "focallengthin35mmfilm", "focallengthin35mmformat")
DIAGONAL = math.hypot(36, 24)
EXIF_BLOCK, EXIF_FOCAL_35 = 0x8769, 0xA405


def focal_of_metadata(path: Path, width: int, height: int) -> tuple[float, str] | None:
    """Focal length in pixels of the source, and what gave it; None if nothing does.

    The equivalent is of the picture's diagonal. A video that is cropped out of the sensor's
    picture, for steadiness, has a longer one: 10 % are common.

    Args:
        path: of a video or a folder of images. width, height: of its frames.
    """
    found = _of_image(path) if path.is_dir() else _of_container(path)
    if found is None:
        return None
    film, name = found
    return film / DIAGONAL * math.hypot(width, height), f"{name}: {film:g} mm on 35 mm film"


def _of_container(path: Path) -> tuple[float, str] | None:
    container, _ = open_video(path)
    with container:
        entries = [container.metadata, *(stream.metadata for stream in container.streams)]
    for metadata in entries:
        for key, value in metadata.items():
            if key.lower().endswith(SUFFIXES) and (film := _positive(value)):
                return film, key
    return None


def _of_image(folder: Path) -> tuple[float, str] | None:
    from PIL import Image

    with Image.open(numbered_frames(folder)[0]) as image:
        value = image.getexif().get_ifd(EXIF_BLOCK).get(EXIF_FOCAL_35)
    film = _positive(value)
    return (film, "EXIF FocalLengthIn35mmFilm") if film else None


def _positive(value: object) -> float | None:
    """A number greater than 0, as files have it; None for 0, which means unknown, and for text."""
    try:
        number = float(str(value))
    except ValueError:
        return None
    return number if math.isfinite(number) and number > 0 else None


@dataclass(frozen=True)
class StaticFocal:
    """A focal length in pixels of the video's own size, and how far to trust it.

    Attributes:
        how: a phrase that tells where it comes from. figures: of the search, for the report.
        known: it is given, or the file's metadata have it.
    """

    pixels: float
    how: str
    figures: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    known: bool = False


def static_focal(video: Frames, landmarks: Landmarks | None, given: float | None) -> StaticFocal:
    """The first of: `given`, the file's metadata, a distinct estimate from the person (`focal`),
    0.8 of the longer side.
    """
    if given is not None:
        return StaticFocal(given, "given", known=True)
    found = focal_of_metadata(video.path, video.native_width, video.native_height)
    if found is not None:
        return StaticFocal(found[0], f"from {found[1]}", known=True)
    longer = max(video.native_width, video.native_height)
    curve = None
    if landmarks is not None:
        size = (video.width, video.height)
        curve = focal_curve(landmarks.image.numpy(), landmarks.world.numpy(), size)
    figures = {} if curve is None else _figures(curve, longer)
    if curve is not None and curve.distinct:
        return _estimated(curve, longer, figures)
    low, high = (round(share * longer) for share in USUAL)
    figures |= {"focal_low_px": low, "focal_high_px": high}
    how = f"assumed: 0.8 x the longer side; all depths scale with it; {low} to {high} px are usual"
    text = (
        f"the focal length is assumed ({low} to {high} px are usual), and every depth is "
        f"proportional to it: give --focal if you know it ({_undecided(curve, longer)})"
    )
    return StaticFocal(ASSUMED_FOCAL * longer, how, figures, (text,))


def _estimated(curve: FocalCurve, longer: int, figures: dict[str, float]) -> StaticFocal:
    best, (low, high) = curve.best * longer, curve.range
    span = f"{low * longer:.0f} to {high * longer:.0f} px are within 5 % of the least error"
    text = (
        f"the focal length, {best:.0f} px, is estimated from the person's landmarks ({span}), and "
        "every depth is proportional to it: give --focal if you know it"
    )
    return StaticFocal(best, f"estimated from the landmarks; {span}", figures, (text,))


def _undecided(curve: FocalCurve | None, longer: int) -> str:
    if curve is None:
        return "too few landmarks are known in space to estimate it"
    low, high = (round(x * longer) for x in curve.range)
    first, second = (half * longer for half in curve.halves)
    return (
        f"the person's landmarks do not determine it: {low} and {high} px explain them equally "
        f"well; the best is {first:.0f} px in the first half of the frames, {second:.0f} px in the "
        "second"
    )


def _figures(curve: FocalCurve, longer: int) -> dict[str, float]:
    low, high = curve.range
    return {
        "focal_best_px": round(curve.best * longer, 1),
        "focal_low_px": round(low * longer, 1),
        "focal_high_px": round(high * longer, 1),
        "focal_error_px": round(float(curve.errors.min()), 3),
    }
