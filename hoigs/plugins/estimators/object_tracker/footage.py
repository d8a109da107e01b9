"""The frames of a video at the size that the tracker works at, and the person's masks of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from hoigs.core.interfaces.estimator import VideoRequest

# Where a person's mask takes in the thing they hold: its parts that are far from their limbs.

SEEN = 0.5  # visibility from which a landmark counts
# Pairs of MediaPipe's landmarks, and the radius of the limb between them, clothes included, in
# lengths of the torso.
LIMBS = (
    ((11, 12), 0.22), ((11, 23), 0.25), ((12, 24), 0.25), ((23, 24), 0.25),
    ((11, 13), 0.20), ((13, 15), 0.16), ((12, 14), 0.20), ((14, 16), 0.16),
    ((15, 19), 0.16), ((16, 20), 0.16),
    ((23, 25), 0.28), ((25, 27), 0.24), ((24, 26), 0.28), ((26, 28), 0.24),
    ((27, 31), 0.20), ((28, 32), 0.20), ((0, 7), 0.40), ((0, 8), 0.40),
)  # fmt: skip
SHOULDERS, HIPS = (11, 12), (23, 24)
TRUNK = tuple((ends, radius) for ends, radius in LIMBS if {*ends} <= {11, 12, 23, 24, 25, 26})
TORSO = tuple((ends, radius) for ends, radius in LIMBS if {*ends} <= {11, 12, 23, 24})
SLEEVES = tuple((ends, radius) for ends, radius in LIMBS if ends in ((11, 13), (12, 14)))
# Pairs of landmarks between which the body itself is seen, if anything of it is: what lies farther
# in front of the body than its limbs hides the middle of the torso first.
BARE = (
    (11, 12), (11, 13), (13, 15), (12, 14), (14, 16), (15, 19), (16, 20), (23, 25), (25, 27),
    (24, 26), (26, 28), (7, 8),
)  # fmt: skip
THIN = 0.07  # radius of these, in torsos
TALLER = 1.4  # breadths of the shoulders that a torso is long
SAMPLED = 12  # frames in which the body's colours are learnt


def skeletons(
    video: VideoRequest, numbers: Sequence[int], scale: float
) -> list[Float[np.ndarray, "F 33 4"]]:
    """Each person's landmarks in frames of a video that is enlarged by `scale`."""
    known = None if video.known is None else video.known.landmarks
    enlarged = np.array((scale, scale, 1.0, 1.0), np.float32)
    return [track.image_xyzv[list(numbers)] * enlarged for track in (known or {}).values()]


def held_pixels(
    person: Bool[np.ndarray, "F h w"], people: Sequence[Float[np.ndarray, "F 33 4"]]
) -> Bool[np.ndarray, "F h w"]:
    """Pixels of the mask of all people that no limb reaches; none in frames in which somebody's
    limbs are unknown, who would be taken for a thing."""
    held = np.zeros_like(person)
    torsos = [torso_length(landmarks) for landmarks in people]
    for i in np.flatnonzero(person.any((1, 2))):
        bodies = [
            limbs(person.shape[1:], landmarks[i], torso[i])
            for landmarks, torso in zip(people, torsos, strict=True)
        ]
        known = [body for body in bodies if body is not None]
        if known and len(known) == len(bodies):
            held[i] = person[i] & ~np.any(known, axis=0)
    return held


def torso_length(landmarks: Float[np.ndarray, "F 33 4"]) -> Float[np.ndarray, "F"]:
    """Pixels from the shoulders to the hips, at least 0.8 of what it is over the whole video, since
    a person who bends towards the camera is no thinner. NaN where the video never shows them."""
    middle = [landmarks[:, pair, :2].mean(1) for pair in (SHOULDERS, HIPS)]
    length = np.linalg.norm(middle[0] - middle[1], axis=-1)
    length[(landmarks[:, SHOULDERS + HIPS, 3] < SEEN).any(1)] = np.nan
    if not np.isfinite(length).any():
        return length
    usual = np.nanquantile(length, 0.75)
    return np.fmax(length, 0.8 * usual)


def usual_torso(people: Sequence[Float[np.ndarray, "F 33 4"]]) -> float:
    """The usual length of a torso in pixels, by the breadth of the shoulders where no hips are ever
    seen, as of somebody at a table; NaN where nobody's shoulders are."""
    lengths = np.concatenate([torso_length(p) for p in people] or [np.array([np.nan])])
    if np.isfinite(lengths).any():
        return float(np.nanmedian(lengths))
    seen = [p[(p[:, SHOULDERS, 3] > SEEN).all(1)] for p in people]
    broad = [np.linalg.norm(p[:, 11, :2] - p[:, 12, :2], axis=-1) for p in seen]
    every = np.concatenate(broad) if broad else np.zeros(0)
    return TALLER * float(np.quantile(every, 0.75)) if len(every) else float("nan")


def limbs(
    shape: tuple[int, int],
    landmarks: Float[np.ndarray, "33 4"],
    torso: float,
    pairs: Sequence[tuple[tuple[int, int], float]] = LIMBS,
) -> Bool[np.ndarray, "h w"] | None:
    """Pixels that the body of one person may cover; None where their torso is not seen.

    Args:
        torso: its length, pixels. pairs: the limbs, as in LIMBS; TRUNK has torso and thighs alone.
    """
    if not (np.isfinite(torso) and (landmarks[[*SHOULDERS, *HIPS], 3] > SEEN).all()):
        return None
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    found = _inside(x, y, landmarks[[11, 12, 24, 23], :2])
    for (a, b), radius in pairs:
        # an end that is not seen is still where the limb would be: it is rather body than thing
        found |= _from_line(x, y, landmarks[a, :2], landmarks[b, :2]) < radius * torso
    return found


def bare_limbs(
    shape: tuple[int, int], people: Sequence[Float[np.ndarray, "33 4"]], torso: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels on the thin middles of limbs that are seen."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    found = np.zeros(shape, bool)
    for points in people:
        lines = [points[list(ends), :2] for ends in BARE if points[list(ends), 3].min() > SEEN]
        if points[list(SHOULDERS), 3].min() > SEEN:  # and of the torso its upper third
            top, bottom = (points[list(pair), :2].mean(0) for pair in (SHOULDERS, HIPS))
            lines.append(np.stack((top, top + (bottom - top) / 3)))
        for start, end in lines:
            found |= _from_line(x, y, start, end) < THIN * torso
    return found


def _from_line(x: np.ndarray, y: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance of pixels from a piece of a line."""
    along = end - start
    share = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / max(along @ along, 1e-9)
    share = share.clip(0, 1)
    return np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1])


def _inside(x: np.ndarray, y: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Pixels inside a polygon, by crossings of a ray to the right."""
    found = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, 0), strict=True):
        if y0 != y1:
            found ^= ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return found


BUDGET = (
    400_000_000  # bytes that the frames may take; longer videos are worked on at a smaller size
)


@dataclass(frozen=True)
class Footage:
    """The frames to work on, reduced.

    Attributes:
        numbers: number of each frame in the video. scale: pixels here per pixel of the video.
        lab: CIE L*a*b*, as uint8: L* times 2.55, a* and b* plus 128.
        person: pixels that the person's mask covers; all False where there is none.
        blank: pixels that show nothing, such as the black corners of a stabilised video.
        held: pixels of the person's mask that no limb of theirs reaches: rather a thing they hold,
            or wide clothes. All False where landmarks are unknown.
        limbs: colours along people's limbs over the video; None where these are unknown.
        people: landmarks of each person.
    """

    numbers: tuple[int, ...]
    scale: float
    lab: UInt8[np.ndarray, "F h w 3"]
    person: Bool[np.ndarray, "F h w"]
    blank: Bool[np.ndarray, "F h w"]
    held: Bool[np.ndarray, "F h w"]
    limbs: Float[np.ndarray, "B"] | None = None
    people: Sequence[Float[np.ndarray, "F 33 4"]] = ()

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.lab.shape[1], self.lab.shape[2]

    @property
    def diagonal(self) -> float:
        return float(np.hypot(*self.shape))

    @property
    def unit(self) -> int:
        """A few pixels, by which masks are wrong."""
        return max(1, round(0.004 * self.diagonal))

    def body(self, i: int) -> Bool[np.ndarray, "h w"]:
        """The person's mask of one frame without what they may hold."""
        return self.person[i] & ~self.held[i]

    def colors(self, i: int) -> Float[np.ndarray, "h w 3"]:
        """L*a*b* of one frame as float32, with lightness at half weight, as shadows change it."""
        return to_features(self.lab[i])


def body_colors(
    footage: Footage, people: Sequence[Float[np.ndarray, "F 33 4"]]
) -> Float[np.ndarray, "B"] | None:
    """Colours along the limbs in most of some frames, as a thing that is held covers them now and
    then; None where no torso is seen."""
    torso, found = usual_torso(people), []
    if not np.isfinite(torso):
        return None
    for i in np.unique(np.linspace(0, len(footage) - 1, SAMPLED).astype(int)).tolist():
        bare = bare_limbs(footage.shape, [p[i] for p in people], torso) & footage.person[i]
        found += [histogram(bins_of(footage.colors(i)), bare * 1.0)] if bare.any() else []
    return np.median(found, 0) if found else None


def to_features(lab: np.ndarray) -> Float[np.ndarray, "... 3"]:
    """Stored L*a*b* as the features in which colours are compared."""
    return (lab.astype(np.float32) - _NEUTRAL) * _WEIGHTS


def read_footage(
    video: VideoRequest,
    person: Sequence[Bool[np.ndarray, "H W"]] | None,
    also: Sequence[int] = (),
    longest: int = 640,
    progress: Callable[[float], None] = lambda share: None,
) -> Footage:
    """The wanted frames of `video`, and those of `also`, reduced to `longest` pixels.

    Args:
        person: masks of the person at the video's size, one for each frame of the video.
    """
    numbers = tuple(sorted({*video.numbers, *also}))
    scale = min(1.0, longest / max(video.width, video.height))
    cost = 5 * len(numbers) * video.width * video.height
    scale = min(scale, float(np.sqrt(BUDGET / cost)))
    size = (max(8, round(video.height * scale)), max(8, round(video.width * scale)))
    lab = np.empty((len(numbers), *size, 3), np.uint8)
    covered = np.zeros((len(numbers), *size), bool)
    blank = np.zeros((len(numbers), *size), bool)
    wanted = np.asarray(video.numbers)
    for i, number in enumerate(numbers):
        image = _reduced(video.frame(number), size)
        lab[i] = lab_of(image)
        if (black := image.max(-1) < 6).mean() > 0.001:
            blank[i] = ndimage.binary_opening(black, iterations=4)
        if person is not None:
            nearest = int(wanted[np.abs(wanted - number).argmin()])
            covered[i] = _reduced(person[nearest].astype(np.uint8) * 255, size) > 127
        progress((i + 1) / len(numbers))
    blank &= _is_border(blank)
    scale = size[1] / video.width
    people = skeletons(video, numbers, scale)
    held = held_pixels(covered, people)
    footage = Footage(numbers, scale, lab, covered, blank, held, people=people)
    return replace(footage, limbs=body_colors(footage, people))


def lab_of(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB as CIE L*a*b* in uint8 (white of D65); tables make it twenty times as fast as kornia."""
    white = np.array([0.950456, 1.0, 1.088754], np.float32)
    xyz = _LINEAR[image] @ (_TO_XYZ.T / white)
    f = _ROOTS[np.rint(xyz * (len(_ROOTS) - 1)).astype(np.int32).clip(0, len(_ROOTS) - 1)]
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    lab = np.stack((2.55 * (116 * y - 16), 500 * (x - y) + 128, 200 * (y - z) + 128), -1)
    return np.clip(np.rint(lab), 0, 255).astype(np.uint8)


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Light of each value of sRGB, and f(t) of CIE L*a*b* over [0, 1]."""
    value, t = np.arange(256) / 255, np.linspace(0, 1, 8192)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    roots = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return linear.astype(np.float32), roots.astype(np.float32)


_LINEAR, _ROOTS = _tables()
_TO_XYZ = np.array(
    [
        [0.412453, 0.357580, 0.180423],
        [0.212671, 0.715160, 0.072169],
        [0.019334, 0.119193, 0.950227],
    ],
    np.float32,
)
_NEUTRAL = np.array([0, 128, 128], np.float32)
_WEIGHTS = np.array([0.3, 1.0, 1.0], np.float32)


def _reduced(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    from PIL import Image

    if image.shape[:2] == size:
        return image
    return np.asarray(Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BOX))


def _is_border(blank: Bool[np.ndarray, "F h w"]) -> Bool[np.ndarray, "F h w"]:
    """Blank regions that touch the edge of the image; black areas inside it are kept."""
    kept = np.zeros_like(blank)
    for i in np.flatnonzero(blank.any((1, 2))):
        labels, _ = ndimage.label(blank[i])
        edge = np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1]))
        kept[i] = np.isin(labels, np.unique(edge[edge > 0]))
    return kept


# Square windows around the object, at a size of at most about 120 pixels a side.

SIDE = 120


@dataclass(frozen=True)
class Window:
    """A square of `n` by `n` cells of `step` pixels each, from the pixel (x, y)."""

    x: int
    y: int
    n: int
    step: int

    @classmethod
    def around(cls, x: float, y: float, half: float) -> Window:
        step = max(1, int(np.ceil(2 * half / SIDE)))
        n = int(np.ceil(2 * half / step))
        return cls(round(x - n * step / 2), round(y - n * step / 2), n, step)

    def at(self, x: float, y: float) -> Window:
        """A window of the same size around another point."""
        side = self.n * self.step / 2
        return Window(round(x - side), round(y - side), self.n, self.step)

    @property
    def center(self) -> tuple[float, float]:
        side = self.n * self.step / 2
        return self.x + side, self.y + side

    def cells(self, x: np.ndarray | float, y: np.ndarray | float) -> tuple:
        """Pixels of the image to cells of the window."""
        return (x - self.x) / self.step, (y - self.y) / self.step

    def cut(self, image: np.ndarray, outside: float = 0.0) -> np.ndarray:
        """The mean of each cell as float32; `outside` where the window leaves the image."""
        side = self.n * self.step
        h, w = image.shape[:2]
        part = np.full((side, side, *image.shape[2:]), outside, np.float32)
        y0, y1 = max(self.y, 0), min(self.y + side, h)
        x0, x1 = max(self.x, 0), min(self.x + side, w)
        if y0 < y1 and x0 < x1:
            part[y0 - self.y : y1 - self.y, x0 - self.x : x1 - self.x] = image[y0:y1, x0:x1]
        if self.step == 1:
            return part
        return part.reshape(self.n, self.step, self.n, self.step, *image.shape[2:]).mean((1, 3))

    def inside(self, shape: tuple[int, int]) -> np.ndarray:
        """Cells that lie in the image."""
        return self.cut(np.ones(shape, np.uint8)) > 0.5

    def paste(self, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """The window's values on a black image, interpolated to pixels."""
        from PIL import Image

        side = self.n * self.step
        grey = Image.fromarray(np.rint(values * 255).clip(0, 255).astype(np.uint8))
        full = np.asarray(grey.resize((side, side), Image.Resampling.BILINEAR))
        out = np.zeros(shape, np.uint8)
        y0, y1 = max(self.y, 0), min(self.y + side, shape[0])
        x0, x1 = max(self.x, 0), min(self.x + side, shape[1])
        if y0 < y1 and x0 < x1:
            out[y0:y1, x0:x1] = full[y0 - self.y : y1 - self.y, x0 - self.x : x1 - self.x]
        return out


# Colours of the object against colours of everything else: two histograms.

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
