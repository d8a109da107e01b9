"""Where equal objects are in a frame: copies of one's shape that cover what looks like it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.signal import fftconvolve

from hoigs.plugins.estimators.object_tracker.path import center_of

ACROSS = 8  # cells of the grid across the object's radius
NEW = 0.14  # share of a place that no other one covers, from which it is one
RIMS = 0.2  # less that a pixel says for an object, as looks are blurred beyond its rim
BODY = -0.1  # least that a pixel of a person says against an object, as it may hide it
ROUNDS, NEAR = 3, 4  # of moving the places, by so many cells


@dataclass(frozen=True)
class Place:
    """Where one of the objects may be: its middle x, y in pixels, and the share of it that only it
    covers."""

    middle: Float[np.ndarray, "2"]
    new: float


@dataclass(frozen=True)
class Shape:
    """The clicked shape.

    Attributes:
        step: pixels of a cell of the grid on which its places are. cells: its share of each, about
            the middle one, of an odd number of rows and columns.
    """

    mask: Bool[np.ndarray, "h w"]
    step: int
    cells: Float[np.ndarray, "n m"]

    @classmethod
    def of(cls, mask: Bool[np.ndarray, "h w"]) -> Shape:
        step = max(1, int(np.sqrt(mask.sum() / np.pi) / ACROSS))
        (x, y), (rows, columns) = center_of(mask), np.nonzero(mask)
        n = int(np.abs(rows + 0.5 - y).max() / step) + 1
        m = int(np.abs(columns + 0.5 - x).max() / step) + 1
        at = np.mgrid[-n : n + 1, -m : m + 1] * step + np.array((y, x))[:, None, None] - 0.5
        smooth = ndimage.gaussian_filter(mask.astype(float), 0.4 * step)
        return cls(mask, step, ndimage.map_coordinates(smooth, at, order=1))

    @property
    def breadth(self) -> float:
        return float(np.sqrt(self.mask.sum()))

    def drawn(self, middle: Float[np.ndarray, "2"]) -> Bool[np.ndarray, "h w"]:
        """The mask moved to a middle x, y."""
        x, y = middle - center_of(self.mask)
        return ndimage.shift(self.mask.astype(np.float32), (y, x), order=1) > 0.5


@dataclass(frozen=True)
class Cover:
    """What of a grid says that one of the objects is there, and how copies of the shape cover it.

    Attributes:
        says: -1 to 1 a cell, on a grid with room for the shape beyond each side. form: the shape's
            share of each cell.
    """

    says: Float[np.ndarray, "r c"]
    form: Float[np.ndarray, "n m"]

    def left(self, cells: Sequence[tuple[int, int]]) -> Float[np.ndarray, "r c"]:
        """What copies about some cells do not cover."""
        left = self.says.copy()
        for cell in cells:
            self._below(left, cell)[...] *= 1 - self.form
        return left

    def _below(self, grid: np.ndarray, cell: tuple[int, int], near: int = 0) -> np.ndarray:
        half = [n // 2 + near for n in self.form.shape]
        return grid[tuple(slice(k - n, k + n + 1) for k, n in zip(cell, half))]

    def new(self, cells: Sequence[tuple[int, int]], k: int) -> float:
        """The share of copy `k` that no other one covers."""
        left = self.left([*cells[:k], *cells[k + 1 :]])
        return float((self._below(left, cells[k]) * self.form).sum() / self.form.sum())

    def gain(self, left: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "p q"]:
        """What a copy covers about each cell that has room for it."""
        return fftconvolve(left, self.form[::-1, ::-1], mode="valid")

    def moved(self, cells: Sequence[tuple[int, int]], fixed: int) -> list[tuple[int, int]]:
        """Copies moved in turn to cover most, but the first few."""
        found, room = list(cells), [n // 2 + NEAR for n in self.form.shape]
        for _ in range(ROUNDS):
            for k in range(fixed, len(found)):
                left = self.left([*found[:k], *found[k + 1 :]])
                gain = self.gain(self._below(left, found[k], NEAR))
                step = np.subtract(np.unravel_index(gain.argmax(), gain.shape), NEAR)
                cell = np.clip(np.add(found[k], step), room, np.subtract(left.shape, room) - 1)
                found[k] = (int(cell[0]), int(cell[1]))
        return found


def places_of(
    odds: Float[np.ndarray, "h w"],
    person: Bool[np.ndarray, "h w"],
    shape: Shape,
    known: Sequence[Float[np.ndarray, "2"]],
    most: int,
) -> list[Place]:
    """Up to `most` places of a frame, those `known` first, of which each covers what no other does.

    One more is put where it covers most of what looks like the objects and is not covered yet, and
    all are moved to cover more, as long as that gains enough: two objects of which one is partly
    behind the other are found by the outline of both.
    """
    step, form = shape.step, shape.cells
    rows, columns = (n // step for n in odds.shape)
    says = np.tanh(odds / 2) - RIMS
    says = np.where(person, np.maximum(says, BODY), says)[: rows * step, : columns * step]
    room = [n // 2 + NEAR for n in form.shape]
    says = says.reshape(rows, step, columns, step).mean((1, 3))
    cover = Cover(np.pad(says, [(n, n) for n in room]), form)
    cells = [(int(y / step) + room[0], int(x / step) + room[1]) for x, y in known]
    covered = (cover.says - cover.left(cells)).sum()
    while len(cells) < most:
        gain = cover.gain(cover.left(cells)[NEAR:-NEAR, NEAR:-NEAR])  # about cells of the picture
        r, c = np.unravel_index(gain.argmax(), gain.shape)
        more = [*cells, (int(r) + room[0], int(c) + room[1])]
        more = cover.moved(more, len(known))
        now = (cover.says - cover.left(more)).sum()
        if now < covered + NEW * form.sum():
            break
        cells, covered = more, now
    middles = [(np.subtract(cell, room)[::-1] + 0.5) * step for cell in cells]
    return [Place(np.array(m), cover.new(cells, k)) for k, m in enumerate(middles)]
