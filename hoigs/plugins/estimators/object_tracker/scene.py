"""Which pixels differ from the scene behind, for static and for moving cameras."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage, to_features

# How the picture of the scene moves between frames: homographies, from matched blocks.

STILL = 0.35  # pixels between frames below which a camera counts as static
SHOWN = 0.2  # of the frames, in which a black border that comes and goes shows a picture
COMES, LIT = 0.002, 20  # such pixels of all, from which there is one; their lightness, of 255
BLOCK = 48


def homographies(footage: Footage) -> Float[np.ndarray, "F 3 3"]:
    """From each frame to the next: x' ~ H x in pixels of the footage; the last is the identity."""
    found = np.tile(np.eye(3), (len(footage), 1, 1))
    for i in range(len(footage) - 1):
        hidden = footage.person[i] | footage.blank[i] | footage.blank[i + 1]
        found[i] = _between(_grey(footage, i), _grey(footage, i + 1), hidden)
    return found


def is_static(footage: Footage, samples: int = 16) -> bool:
    """Whether the picture of the scene stays where it is, by blocks of frames across the video. A
    black border that comes and goes is that of a video which was stabilised; one that stays is a
    letterbox, or a dark wall at the edge of the picture."""
    picks = np.unique(np.linspace(0, len(footage) - 1, samples).astype(int))
    moved = []
    for a, b in pairwise(picks):
        hidden = footage.person[a] | footage.person[b] | footage.blank[a] | footage.blank[b]
        at, shift, weight = _matches(_grey(footage, a), _grey(footage, b), hidden)
        if len(at):
            order = np.hypot(*shift.T).argsort()
            share = weight[order].cumsum() / weight.sum()
            moved.append(np.hypot(*shift.T)[order][np.searchsorted(share, 0.5)])
    lit = (footage.lab[..., 0] > LIT) & ~footage.person & ~footage.blank
    comes = (footage.blank.any(0) & (lit.mean(0) > SHOWN)).mean() > COMES
    return bool(moved) and float(np.median(moved)) < 2 * STILL and not comes


def chained(steps: Float[np.ndarray, "F 3 3"], a: int, b: int) -> Float[np.ndarray, "3 3"]:
    """The homography from frame `a` to frame `b`."""
    total = np.eye(3)
    for i in range(min(a, b), max(a, b)):
        total = steps[i] @ total
    return total if a <= b else np.linalg.inv(total)


def moved_points(h: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "... 2"]) -> np.ndarray:
    """Points x, y under a homography."""
    moved = points @ h[:, :2].T + h[:, 2]
    return moved[..., :2] / moved[..., 2:]


def _grey(footage: Footage, i: int) -> Float[np.ndarray, "h w"]:
    return footage.lab[i, ..., 0].astype(np.float32)


def _matches(
    first: Float[np.ndarray, "h w"],
    second: Float[np.ndarray, "h w"],
    hidden: Bool[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"], Float[np.ndarray, "N"]]:
    """Centres of blocks, their displacement x, y by phase correlation, and a weight."""
    size = min(BLOCK, *(side // 2 for side in first.shape))
    window = np.outer(np.hanning(size), np.hanning(size)).astype(np.float32)
    a, b, covered = (_blocks(image, size) for image in (first, second, hidden))
    at = _blocks(np.moveaxis(np.mgrid[: first.shape[0], : first.shape[1]][::-1], 0, -1), size)
    seen = (covered.mean((1, 2)) < 0.2) & (a.std((1, 2)) > 3)
    a, b = (x[seen] - x[seen].mean((1, 2), keepdims=True) for x in (a, b))
    shift, weight = _phase_shifts(a * window, b * window)
    return at[seen].mean((1, 2)) + 0.5, shift, weight


def _blocks(image: np.ndarray, size: int) -> np.ndarray:
    """Square blocks [N, size, size, ...] that cover an image from its upper left corner."""
    rows, columns = image.shape[0] // size, image.shape[1] // size
    cut = image[: rows * size, : columns * size]
    split = cut.reshape(rows, size, columns, size, *image.shape[2:]).swapaxes(1, 2)
    return split.reshape(rows * columns, size, size, *image.shape[2:])


def _phase_shifts(
    a: Float[np.ndarray, "N n n"], b: Float[np.ndarray, "N n n"]
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N"]]:
    """Displacement x, y of each b against its a, and the peak (Kuglin and Hines 1975)."""
    if not len(a):
        return np.zeros((0, 2)), np.zeros(0)
    n = a.shape[-1]
    cross = np.fft.rfft2(b) * np.conj(np.fft.rfft2(a))
    size = np.abs(cross)
    surface = np.fft.irfft2(cross / (size + 1e-3 * size.max((1, 2), keepdims=True)), s=(n, n))
    surface = ndimage.gaussian_filter(surface, (0, 0.7, 0.7), mode="wrap")
    row = np.arange(len(a))
    y, x = np.unravel_index(surface.reshape(len(a), -1).argmax(1), (n, n))

    def between(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
        bend = np.minimum(before - 2 * here + after, -1e-9)
        return 0.5 * (before - after) / bend

    top = surface[row, y, x]
    dy = between(surface[row, y - 1, x], top, surface[row, (y + 1) % n, x])
    dx = between(surface[row, y, x - 1], top, surface[row, y, (x + 1) % n])
    wrapped = (np.stack((x + dx, y + dy), -1) + n / 2) % n - n / 2
    return wrapped, np.maximum(top, 0)


def _between(first: np.ndarray, second: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """The homography that most blocks agree on: least squares, reweighted."""
    at, shift, weight = _matches(first, second, hidden)
    if len(at) < 6:
        return np.eye(3)
    to = at + shift
    middle = np.median(shift, 0)
    off = np.hypot(*(shift - middle).T)
    total = np.eye(3)
    size = max(first.shape)
    for tolerance in (8.0, 4.0, 2.0, 1.0, 1.0):
        w = weight / (1 + (off / tolerance) ** 2) ** 2
        total = _fitted(at / size, to / size, w)
        scale = np.diag([size, size, 1.0])
        total = scale @ total @ np.linalg.inv(scale)
        off = np.hypot(*(moved_points(total, at) - to).T)
    return total


def _fitted(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted least squares for the eight numbers of a homography, held near an affine map."""
    x, y = a.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate((
        np.stack((x, y, one, zero, zero, zero, -x * b[:, 0], -y * b[:, 0]), -1),
        np.stack((zero, zero, zero, x, y, one, -x * b[:, 1], -y * b[:, 1]), -1),
    ))  # fmt: skip
    w = np.concatenate((weight, weight))
    normal = rows.T @ (rows * w[:, None])
    normal[6:, 6:] += np.eye(2) * 1e-2 * w.sum()
    normal += np.eye(8) * 1e-9 * w.sum()
    solved = np.linalg.solve(normal, rows.T @ (w * np.concatenate((b[:, 0], b[:, 1]))))
    return np.append(solved, 1.0).reshape(3, 3)


SAMPLES = 48  # frames of which the median is taken
NEIGHBOURS = (-24, -16, -10, -6, 6, 10, 16, 24)  # frames that a moving camera's are compared with
GONE, FEW = 6.0, 6  # units of noise by which the place of a thing has changed; such samples
SHIFT = 2  # pixels, the largest of the shifts that parallax is allowed
SHIFTS = ((0, 0), (0, 2), (0, -2), (2, 0), (-2, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


class Scene(Protocol):
    """The scene without person and object."""

    def difference(self, i: int) -> Float[np.ndarray, "h w"]:
        """How far frame i is from the scene, in units of its noise; NaN where that is not known."""
        ...


@dataclass(frozen=True)
class StaticScene:
    """The median colour of each pixel while the person is elsewhere, and its spread."""

    footage: Footage
    median: Float[np.ndarray, "h w 3"]
    spread: Float[np.ndarray, "h w"]

    def difference(self, i: int) -> Float[np.ndarray, "h w"]:
        return shadowless(self.footage.colors(i) - self.median, self.median) / self.spread


def static_scene(footage: Footage) -> StaticScene:
    picks = _samples(footage, SAMPLES)
    hidden = footage.person[picks] | footage.blank[picks]
    for row in range(len(picks)):
        hidden[row] = ndimage.binary_dilation(hidden[row], iterations=4)
    return _still_parts(footage, picks, hidden)


def scene_without(scene: StaticScene, i: int, thing: Bool[np.ndarray, "h w"]) -> StaticScene | None:
    """The scene of the frames from which a thing that rests in frame i has gone.

    Args:
        thing: pixels of it in frame i.

    Returns:
        None where it stays, or people hide where it was.
    """
    footage, noise = scene.footage, float(np.nanmedian(scene.spread))
    picks = _samples(footage, 2 * SAMPLES)
    hidden = footage.person[picks] | footage.blank[picks]
    here = footage.colors(i)[thing]
    gone = []
    for row, j in enumerate(picks):
        hidden[row] = ndimage.binary_dilation(hidden[row], iterations=4)
        away = shadowless(footage.colors(j)[thing] - here, here) / noise
        gone.append(not hidden[row][thing].any() and float(np.median(away)) > GONE)
    if sum(gone) < FEW:
        return None
    return _still_parts(footage, picks[gone], hidden[gone])


def scene_behind(footage: Footage, masks: Bool[np.ndarray, "F h w"], around: float) -> StaticScene:
    """What an object passes in front of: the scene, and of people what keeps still.

    Args:
        masks: masks of the object. around: neighbouring pixels that may also belong to it.
    """
    picks = _samples(footage, 2 * SAMPLES)
    hidden = masks[picks] | footage.blank[picks]
    for row in range(len(picks)):
        hidden[row] = ndimage.distance_transform_edt(~hidden[row]) <= around
    return _still_parts(footage, picks, hidden)


def _samples(footage: Footage, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, len(footage) - 1, count).astype(int))


def _still_parts(
    footage: Footage, picks: np.ndarray, hidden: Bool[np.ndarray, "S h w"]
) -> StaticScene:
    """Median and spread of sampled frames where they are not hidden."""
    median, spread = np.empty((*footage.shape, 3), np.float32), np.empty(footage.shape, np.float32)
    for y in range(footage.shape[0]):  # a row of pixels at a time, which fits the cache
        median[y], spread[y] = _median_and_spread(footage.lab[picks, y], hidden[:, y])
    return StaticScene(footage, to_features(median), spread)


def _median_and_spread(
    colors: UInt8[np.ndarray, "S w 3"], hidden: Bool[np.ndarray, "S w"]
) -> tuple[Float[np.ndarray, "w 3"], Float[np.ndarray, "w"]]:
    """Over samples that are not hidden; NaN where fewer than 4 are left."""
    count = (~hidden).sum(0)
    at = np.maximum(count - 1, 0) // 2

    def middle(values: np.ndarray) -> np.ndarray:
        ordered = np.sort(np.where(hidden, 255, values).T, axis=-1).T  # hidden ones go last
        return np.take_along_axis(ordered, at[None], 0)[0]

    median = np.stack([middle(colors[..., c]) for c in range(3)], -1).astype(np.float32)
    away = np.abs(to_features(colors) - to_features(median)).max(-1)
    spread = 1.5 * middle(np.minimum(away, 254).astype(np.uint8))
    median[count < 4] = np.nan
    return median, np.maximum(spread, 1.5).astype(np.float32)


@dataclass(frozen=True)
class MovingScene:
    """The scene as other frames saw it, carried over by homographies.

    What stands out of the plane (parallax) is allowed for by taking the most similar of nearby
    pixels.
    """

    footage: Footage
    steps: Float[np.ndarray, "F 3 3"]
    _kept: dict[int, np.ndarray] = field(default_factory=dict)  # path and masks need each twice

    def difference(self, i: int) -> Float[np.ndarray, "h w"]:
        if i not in self._kept:
            self._kept[i] = self._difference(i).astype(np.float16)
        return self._kept[i].astype(np.float32)

    def _difference(self, i: int) -> Float[np.ndarray, "h w"]:
        here = np.ascontiguousarray(np.moveaxis(self.footage.colors(i), -1, 0))
        found = []
        for offset in NEIGHBOURS:
            j = i + offset
            if 0 <= j < len(self.footage):
                found.append(self._against(here, i, j))
        if not found:
            return np.full(here.shape[1:], np.nan, np.float32)
        stack = np.sort(np.stack(found), axis=0)  # NaN goes last
        count = np.isfinite(stack).sum(0)
        at = np.maximum(count - 1, 0) // 2
        away = np.take_along_axis(stack, at[None], 0)[0]
        away[count < 2] = np.nan
        known = away[np.isfinite(away)]
        noise = max(1.5, 1.5 * float(np.median(known))) if len(known) else 1.5
        return away / noise

    def _against(self, here: np.ndarray, i: int, j: int) -> np.ndarray:
        h = chained(self.steps, i, j)
        rows, columns = self.footage.shape
        y, x = np.mgrid[:rows, :columns].astype(np.float32)
        w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
        v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
        ui, vi = np.rint(u).astype(int), np.rint(v).astype(int)
        inside = (ui >= 0) & (ui < columns) & (vi >= 0) & (vi < rows)
        ui, vi = ui.clip(0, columns - 1), vi.clip(0, rows - 1)
        there = to_features(self.footage.lab[j])[vi, ui]
        # one lookup, then shifts of what was looked up: an image's neighbours stay neighbours
        near = np.pad(np.moveaxis(there, -1, 0), ((0, 0), (SHIFT, SHIFT), (SHIFT, SHIFT)), "edge")
        best = np.full((rows, columns), np.inf, np.float32)
        for dy, dx in SHIFTS:
            away = np.zeros((rows, columns), np.float32)
            y, x = SHIFT + dy, SHIFT + dx
            for channel, color in zip(near, here, strict=True):
                apart = channel[y : y + rows, x : x + columns] - color
                away += np.square(apart, out=apart)
            np.minimum(best, away, out=best)
        best = np.sqrt(best)
        hidden = ndimage.binary_dilation(
            self.footage.person[j] | self.footage.blank[j], iterations=3
        )
        best[~inside | hidden[vi, ui] | self.footage.blank[i]] = np.nan
        return best


def moving_scene(footage: Footage) -> MovingScene:
    return MovingScene(footage, homographies(footage))


def carried(
    scene: Scene, points: Float[np.ndarray, "*N 2"], i: int, j: int
) -> Float[np.ndarray, "*N 2"]:
    """Where points x, y of frame i that are a part of the scene lie in frame j."""
    if isinstance(scene, MovingScene):
        return moved_points(chained(scene.steps, i, j), points)
    return points


def median_of(differences: np.ndarray) -> float:
    """Median of the known values; NaN where none is known."""
    known = differences[np.isfinite(differences)]
    return float(np.median(known)) if known.size else float("nan")


def shadowless(
    away: Float[np.ndarray, "*N 3"], scene: Float[np.ndarray, "*N 3"]
) -> Float[np.ndarray, "*N"]:
    """Length of a difference of colours, less where only lightness falls, as in a shadow."""
    light, chroma = away[..., 0], np.hypot(away[..., 1], away[..., 2])
    share = light / np.maximum(scene[..., 0], 1.0)
    shade = (share < 0) & (share > -0.45)
    return np.hypot(np.where(shade, 0.4 * light, light), chroma)
