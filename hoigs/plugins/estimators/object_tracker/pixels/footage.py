"""The frames of a video at the size that the tracker works at, and the person's masks of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from hoigs.core.interfaces.estimator import VideoRequest
from hoigs.plugins.estimators.object_tracker.pixels.held import held_pixels, skeletons

BUDGET = (
    400_000_000  # bytes that the frames may take; longer videos are worked on at a smaller size
)


@dataclass(frozen=True)
class Footage:
    """The frames to work on, reduced.

    Attributes:
        numbers: of each frame, in the video. scale: pixels here per pixel of the video.
        lab: CIE L*a*b*, as uint8: L* times 2.55, a* and b* plus 128.
        person: pixels that the person's mask covers; all False where there is none.
        blank: pixels that show nothing, such as the black corners of a stabilised video.
        held: pixels of the person's mask that no limb of theirs reaches: rather a thing they hold,
            or wide clothes. All False where landmarks are unknown.
    """

    numbers: tuple[int, ...]
    scale: float
    lab: UInt8[np.ndarray, "F h w 3"]
    person: Bool[np.ndarray, "F h w"]
    blank: Bool[np.ndarray, "F h w"]
    held: Bool[np.ndarray, "F h w"]

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
    held = held_pixels(covered, skeletons(video, numbers, scale))
    return Footage(numbers, scale, lab, covered, blank, held)


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
    """Of blank regions, those that touch the edge of the image: not what is merely black."""
    kept = np.zeros_like(blank)
    for i in np.flatnonzero(blank.any((1, 2))):
        labels, _ = ndimage.label(blank[i])
        edge = np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1]))
        kept[i] = np.isin(labels, np.unique(edge[edge > 0]))
    return kept
