"""How the picture of the scene moves between frames: homographies, from matched blocks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.pixels.footage import Footage

STILL = 0.35  # pixels between frames below which a camera counts as static
BLOCK = 48


def homographies(footage: Footage) -> Float[np.ndarray, "F 3 3"]:
    """From each frame to the next: x' ~ H x in pixels of the footage; the last is the identity."""
    found = np.tile(np.eye(3), (len(footage), 1, 1))
    for i in range(len(footage) - 1):
        hidden = footage.person[i] | footage.blank[i] | footage.blank[i + 1]
        found[i] = _between(_grey(footage, i), _grey(footage, i + 1), hidden)
    return found


def is_static(footage: Footage, samples: int = 16) -> bool:
    """Whether the picture of the scene stays where it is, by blocks of frames across the video."""
    picks = np.unique(np.linspace(0, len(footage) - 1, samples).astype(int))
    moved = []
    for a, b in pairwise(picks):
        hidden = footage.person[a] | footage.person[b] | footage.blank[a] | footage.blank[b]
        at, shift, weight = _matches(_grey(footage, a), _grey(footage, b), hidden)
        if len(at):
            order = np.hypot(*shift.T).argsort()
            share = weight[order].cumsum() / weight.sum()
            moved.append(np.hypot(*shift.T)[order][np.searchsorted(share, 0.5)])
    return bool(moved) and float(np.median(moved)) < 2 * STILL and not footage.blank.any()


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
