"""What moves together from a frame to those beside it: a thing, against the body that holds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage

# Frames before and after: of each span the nearest that the footage has. What is held still for a
# moment moves with the hand that holds it, and what is printed on a thing always does.
BESIDE = ((2, 5), (6, 9), (10, 14))
REACH = 9  # quarters of its pixels that a pixel may move between: 36 pixels
LARGEST = 40.0  # difference of colours from which pixels differ entirely
SAME = (1.4, 2.0)  # a motion explains a pixel up to so much of its own best cost, and more
FOUND = 7.0  # mean difference of colours up to which a mask is found again; at twice it is not
NEAREST = 0.7  # how far it counts as found again, at least, in the nearest frames
INVERTED = 3  # steps by which a motion is inverted: it is nearly a translation
RIM = 0.12  # breadth of the surroundings of a mask, of the root of its area


@dataclass(frozen=True)
class Motion:
    """How the half-size picture of a frame is found again in those beside it.

    Attributes:
        here: colours. beside: of each other frame its colours, the shift y, x of each pixel to it,
            what is left of the difference (block matching, coarse to fine), and whether it is one
            of the nearest.
    """

    here: Float[np.ndarray, "h w 3"]
    beside: Sequence[
        tuple[Float[np.ndarray, "h w 3"], Int[np.ndarray, "2 h w"], Float[np.ndarray, "h w"], bool]
    ]

    @classmethod
    def of(cls, footage: Footage, i: int) -> Motion:
        """None of the frames beside it where the footage does not have them."""
        here, number, beside = _halved(footage.colors(i)), footage.numbers[i], []
        for way, (first, last) in product((-1, 1), BESIDE):
            apart = [(way * (n - number), k) for k, n in enumerate(footage.numbers)]
            near = min((a for a in apart if first <= a[0] <= last), default=None)
            if near is not None:
                there = _halved(footage.colors(near[1]))
                shift = _shifts(here, there)
                least = _costs(here, there, shift, 3)
                beside.append((there, shift, least, first == BESIDE[0][0]))
        return cls(here, beside)

    def sets_off(self, mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "K 3"]:
        """How much better one affine motion explains a mask than what is around it, to each of the
        frames beside it.

        Returns:
            The share of the mask that it explains less that of its surroundings; and how much worse
            than each pixel's own shift it does in these than in the mask, as logarithm; and how far
            the mask is found again by it, 0 to 1.
        """
        rows, columns = self.here.shape[:2]
        cut = mask[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
        small = cut.mean((1, 3)) > 0.5
        breadth = max(2, int(RIM * np.sqrt(mask.sum()))) // 2 + 1
        grown = ndimage.binary_dilation(small)
        around = ndimage.binary_dilation(grown, iterations=breadth) & ~grown
        found = []
        for there, shift, least, near in self.beside if small.any() and around.any() else ():
            cost = _costs(self.here, there, np.rint(_affine(small, shift)).astype(int), 3)
            fits, worse = cost < SAME[0] * least + SAME[1], np.log1p(np.maximum(cost - least, 0))
            again = np.clip(2 - cost[small].mean() / FOUND, NEAREST if near else 0, 1)
            apart = [of[small].mean() - of[around].mean() for of in (fits, -worse)]
            found.append((*apart, again))
        return np.array(found).reshape(-1, 3)


def moved_on(
    footage: Footage, i: int, j: int, mask: Bool[np.ndarray, "H W"]
) -> tuple[Bool[np.ndarray, "H W"], float, float]:
    """Where the pixels of a mask of frame `i` are in frame `j`, by the affine motion that most of
    them share; the share of them that it explains as well as a motion of their own; and by how much
    their colours differ there, the mean over them of the sum over channels."""
    reach = 2 * 2 * (REACH + 2)  # pixels: the longest shift of the half-size picture
    y, x = np.nonzero(mask)
    rows, columns = (slice(max(v.min() - reach, 0), v.max() + 1 + reach) for v in (y, x))
    here, there = (_halved(footage.colors(k)[rows, columns]) for k in (i, j))
    small = _halved(mask[rows, columns, None].astype(np.float32))[..., 0] > 0.5
    moved = np.zeros_like(mask)
    if not small.any():
        return moved, 0.0, LARGEST
    shift = _shifts(here, there)
    steps = _affine(small, shift)
    least, cost = (_costs(here, there, s, 3) for s in (shift, np.rint(steps).astype(int)))
    fits = float((cost < SAME[0] * least + SAME[1])[small].mean())
    to = np.indices(small.shape).astype(float)
    at = to - steps
    for _ in range(INVERTED):
        at = to - [ndimage.map_coordinates(s, at, order=1, mode="nearest") for s in steps]
    found = ndimage.map_coordinates(small.astype(np.float32), at, order=1) > 0.5
    found = found.repeat(2, 0).repeat(2, 1)
    moved[rows, columns][: found.shape[0], : found.shape[1]] = found
    return moved, fits, float(cost[small].mean())


def _halved(colors: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "h w C"]:
    rows, columns = colors.shape[0] // 2, colors.shape[1] // 2
    return colors[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, -1).mean((1, 3))


def _costs(
    here: Float[np.ndarray, "h w 3"],
    there: Float[np.ndarray, "h w 3"],
    shift: Int[np.ndarray, "2 #h #w"],
    size: int = 5,
) -> Float[np.ndarray, "h w"]:
    """Difference of colours from each pixel to the one that its shift leads to, over squares."""
    rows, columns = here.shape[:2]
    y, x = np.ogrid[:rows, :columns]
    moved = there[(y + shift[0]).clip(0, rows - 1), (x + shift[1]).clip(0, columns - 1)]
    apart = np.abs(here - moved)
    apart = np.minimum(apart[..., 0] + apart[..., 1] + apart[..., 2], LARGEST)
    return ndimage.uniform_filter(apart, size, mode="nearest")


def _shifts(here: np.ndarray, there: np.ndarray) -> Int[np.ndarray, "2 h w"]:
    """The best shift of each pixel: all of half the size within REACH, then those next to it."""
    coarse = _best(_halved(here), _halved(there), np.zeros((2, 1, 1), int), REACH)
    coarse = np.stack([ndimage.median_filter(axis, 5) for axis in coarse])
    rows, columns = here.shape[:2]
    fine = 2 * coarse.repeat(2, 1).repeat(2, 2)
    beyond = ((0, 0), (0, rows - fine.shape[1]), (0, columns - fine.shape[2]))
    return _best(here, there, np.pad(fine, beyond, mode="edge"), 2)


def _best(
    here: np.ndarray, there: np.ndarray, about: Int[np.ndarray, "2 #h #w"], reach: int
) -> Int[np.ndarray, "2 h w"]:
    """The shift of least cost within `reach` of one that is known; a shorter one of equal ones."""
    least = np.full(here.shape[:2], np.inf)
    found = np.zeros((2, *least.shape), int)
    steps = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    for step in steps[np.argsort(np.hypot(*steps.T), kind="stable")]:
        shift = about + step[:, None, None]
        cost = _costs(here, there, shift) + 0.05 * np.hypot(*step)
        better = cost < least
        least[better] = cost[better]
        found[:, better] = np.broadcast_to(shift, found.shape)[:, better]
    return found


def _affine(mask: Bool[np.ndarray, "h w"], shift: Int[np.ndarray, "2 h w"]) -> np.ndarray:
    """Shifts [2, h, w] of the affine motion that most pixels of a mask share: least squares,
    reweighted, and held near a translation."""
    y, x = np.nonzero(mask)
    middle, half = np.array((y.mean(), x.mean())), max(np.ptp(y), np.ptp(x)) / 2 + 1.0

    def terms(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        at = (np.stack((y, x), -1) - middle) / half
        return np.concatenate((np.ones((*at.shape[:-1], 1)), at.clip(-2, 2)), -1)

    near, seen = terms(y, x), shift[:, y, x].T.astype(float)
    hold = np.diag((1e-6, 0.005, 0.005)) * len(y)
    off = np.hypot(*(seen - np.median(seen, 0)).T)
    for tolerance in (6.0, 3.0, 2.0, 1.5):
        weight = 1 / (1 + (off / tolerance) ** 2)[:, None] ** 2
        solved = np.linalg.solve(near.T @ (weight * near) + hold, near.T @ (weight * seen))
        off = np.hypot(*(seen - near @ solved).T)
    return np.moveaxis(terms(*np.indices(mask.shape)) @ solved, -1, 0)
