"""Whether the camera moves: displacement of image features outside the masks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage

from hoigs.preparation.cameras.turning import SHARE, Pair, turn_share
from hoigs.preparation.estimates.given import GivenMasks
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.pictures import shrink, shrink_mask

# COLMAP without lines of its log in the terminal.


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs nothing in this block: an attempt that fails is followed by others, and if all do
    there is an error of ours."""
    from hoigs.core.system.colmap import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


FRAMES = 6  # compared with the first; SIFT takes about half a second each
WIDTH = 640  # at which they are
FEATURES, ENOUGH = 1500, 25  # of an image; matches that make a pair count
STILL = 1.0  # pixels at WIDTH: codecs and rolling light move features by a few tenths
MARGIN = 0.01  # of the width: masks are grown by it
Features = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 128"]]


@dataclass(frozen=True)
class BackgroundMotion:
    """Displacement of features outside the masks since the first frame.

    Attributes:
        displacement: pixels at a width of 640, the median over features, of each compared frame;
            NaN where too few features were found again.
        matches: features found again, of each compared frame.
        features: in the first frame.
        turned: degrees that the camera turns by at most, if turns alone explain where the features
            of neighbouring compared frames went; None if they do not, or cannot be known.
    """

    displacement: Float[np.ndarray, " C"]
    matches: list[int]
    features: int
    turned: float | None = None

    @property
    def known(self) -> bool:
        """Whether enough features lie in the background to decide."""
        return self.features >= ENOUGH

    @property
    def static(self) -> bool:
        """Whether the camera stands still: what is found again has not moved, and most is found."""
        seen = np.isfinite(self.displacement)
        if not self.known or seen.mean() < 0.5:
            return not self.known
        return bool(np.quantile(self.displacement[seen], 0.75) < STILL)

    @property
    def largest(self) -> float:
        """Largest median displacement, pixels at a width of 640; 0 if nothing was found again."""
        seen = np.isfinite(self.displacement)
        return float(self.displacement[seen].max()) if seen.any() else 0.0


def background_motion(video: Frames, masks: GivenMasks) -> BackgroundMotion:
    """Compares frames spread over the video with the first one."""
    chosen = sorted(set(np.linspace(0, len(video) - 1, FRAMES + 1).round().astype(int).tolist()))
    found = list(background_features(video, masks, chosen))
    displacement, matches = [], []
    for other in found[1:]:
        one, two = paired(found[0], other)
        matches.append(len(one))
        moved = np.linalg.norm(one - two, axis=-1)
        displacement.append(float(np.median(moved)) if len(one) >= ENOUGH else np.nan)
    motion = BackgroundMotion(np.array(displacement), matches, len(found[0][0]))
    if motion.static:
        return motion
    size = (WIDTH, round(video.height * WIDTH / video.width))
    return replace(motion, turned=_turned([paired(a, b) for a, b in pairwise(found)], size))


def _turned(pairs: list[Pair], size: tuple[int, int]) -> float | None:
    """Degrees of the largest turn between neighbours, if turns explain them all; else None."""
    if min(len(one) for one, _ in pairs) < ENOUGH:
        return None
    share, degrees = turn_share(pairs, size)
    return degrees if share >= SHARE else None


def background_features(
    video: Frames, masks: GivenMasks, chosen: Sequence[int]
) -> Iterator[Features]:
    """SIFT's of the chosen frames, outside the masks: positions, pixels at WIDTH, and unit
    descriptors."""
    from hoigs.core.system.colmap import pycolmap

    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features = FEATURES
    with quiet_colmap():
        sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    for i, image in zip(chosen, video.subset(chosen), strict=True):
        yield _features(sift, image, masks.moving(i))


def paired(one: Features, two: Features) -> Pair:
    """Positions of the features that are found in both images."""
    rows = _matches(one[1], two[1])
    return one[0][rows[:, 0]], two[0][rows[:, 1]]


def _features(sift, image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"]) -> Features:
    """Positions, pixels at WIDTH, and unit descriptors of features outside the mask."""
    scale = WIDTH / image.shape[1]
    size = (min(WIDTH, image.shape[1]), max(1, round(image.shape[0] * min(1.0, scale))))
    small = shrink(image, *size)
    grey = np.ascontiguousarray(np.array(Image.fromarray(small).convert("L")))
    hidden = shrink_mask(grown(moving), *size)
    keypoints, found = sift.extract_from_uint8_array(grey)
    xy = np.array([(k.x, k.y) for k in keypoints], np.float64).reshape(-1, 2)
    column, row = np.clip(xy.astype(int), 0, np.array(size) - 1).T
    seen = ~hidden[row, column]
    descriptors = np.asarray(found.data, np.float32)[seen]
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True).clip(1e-6)
    return xy[seen] * (WIDTH / size[0]), descriptors


def _matches(
    one: Float[np.ndarray, "N 128"], two: Float[np.ndarray, "M 128"], ratio: float = 0.8
) -> np.ndarray:
    """Pairs of mutual nearest neighbours that pass Lowe's ratio test, int [P, 2]."""
    if min(len(one), len(two)) < 2:
        return np.zeros((0, 2), int)
    similar = one @ two.T
    best = similar.argmax(1)
    top = np.sort(similar, axis=1)[:, -2:]
    distance = np.sqrt((2 - 2 * top).clip(0))
    clear = distance[:, 1] < ratio * distance[:, 0]
    mutual = similar.argmax(0)[best] == np.arange(len(one))
    rows = np.flatnonzero(clear & mutual)
    return np.stack((rows, best[rows]), 1)


def grown(mask: Bool[np.ndarray, "H W"], margin: float = MARGIN) -> Bool[np.ndarray, "H W"]:
    """The mask, larger by a part of its width: outlines move with what they bound."""
    pixels = max(1, round(margin * mask.shape[1]))
    return ndimage.binary_dilation(mask, iterations=pixels)
