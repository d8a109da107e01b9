"""Lines from a point in one frame, and how much speaks for each: pixels unlike those beside them.

A pixel of a thin thing differs from the scene more than those beside it do, whatever its colour;
one before a body, of which the scene shows nothing, differs from them in colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage
from hoigs.plugins.estimators.object_tracker.scene import Scene

DIFFERS, STANDS_OUT = 6.0, 20.0  # units of noise and of colour that are full evidence
HALF = 25.0  # units of colour off the thing's own at which a pixel before a body counts little
LEAST = 0.2  # evidence of a pixel from which it lengthens a line
STEP = 1.5  # pixels along a line
BLURRED = 0.04  # pixels by which sides are farther off for each pixel along: a swing blurs the end


@dataclass(frozen=True)
class Line:
    """A piece of a line in one frame.

    Attributes:
        start: x, y beside the hand. angle: of its direction, from x to y. length: pixels.
        evidence: summed over its pixels. support: share of its pixels that are before no
            body and differ from both sides. color: the median of its pixels.
    """

    start: Float[np.ndarray, "2"]
    angle: float
    length: float
    evidence: float
    support: float
    color: Float[np.ndarray, "3"]

    @property
    def direction(self) -> Float[np.ndarray, "2"]:
        return np.array((np.cos(self.angle), np.sin(self.angle)))

    def away(self, other: Line) -> float:
        """Pixels from the other line's to this one, on average."""
        along, aside = self.off(*other.points().T)
        beyond = np.maximum(-along, along - self.length).clip(0)
        return float(np.hypot(beyond, aside).mean())

    def point(self, share: float) -> Float[np.ndarray, "2"]:
        """x, y at a share of its length."""
        return self.start + share * self.length * self.direction

    def points(self) -> Float[np.ndarray, "S 2"]:
        """x, y along it."""
        return self.start + np.arange(0.0, self.length + STEP / 2, STEP)[:, None] * self.direction

    def off(
        self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """How far along the line pixels are, and how far to its right."""
        dx, dy = x - self.start[0], y - self.start[1]
        ux, uy = self.direction
        return dx * ux + dy * uy, dy * ux - dx * uy


@dataclass(frozen=True)
class Look:
    """How lines of one frame are judged.

    Attributes:
        changed: how far pixels differ from the scene, 1 by DIFFERS units of noise or more. body:
            pixels of people, whom the scene does not show. beside: pixels from the middle of a
            line to its sides. reach: pixels of the longest line. color: the thing's, which tells it
            from folds of clothes; None while it is unknown. on_body: whether pixels before a body
            speak for a line.
    """

    changed: Float[np.ndarray, "h w"]
    body: Bool[np.ndarray, "h w"]
    colors: Float[np.ndarray, "h w 3"]
    beside: float = 0.0
    reach: float = 0.0
    color: Float[np.ndarray, "3"] | None = None
    on_body: bool = True

    @classmethod
    def at(cls, footage: Footage, scene: Scene, i: int) -> Look:
        """At frame `i`."""
        away = np.nan_to_num(scene.difference(i), nan=0.0)
        changed = np.minimum(ndimage.gaussian_filter(away, 0.5), DIFFERS) / DIFFERS
        colors = ndimage.gaussian_filter(footage.colors(i), (0.5, 0.5, 0))
        return cls(changed, footage.body(i), colors)

    def cells(self, points: Float[np.ndarray, "*N 2"]) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of points, those of the rim for points beyond it."""
        x, y = np.moveaxis(points.astype(int), -1, 0)
        height, width = self.body.shape
        return y.clip(0, height - 1), x.clip(0, width - 1)

    def evidence(
        self, starts: Float[np.ndarray, "N 2"], angles: Float[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N S"], tuple[np.ndarray, np.ndarray]]:
        """How much speaks for each pixel along lines, at most 1, and the pixels' rows and columns.

        It is how much more a pixel differs from the scene than those to both sides of it do; before
        a body, how much its colour differs from theirs, and is the thing's.
        """
        s = np.arange(0.0, self.reach, STEP)
        along = np.stack((np.cos(angles), np.sin(angles)), -1)
        across = np.stack((-along[:, 1], along[:, 0]), -1)[:, None]
        middle = starts[:, None] + s[:, None] * along[:, None]
        aside = (self.beside + BLURRED * s)[:, None] * across
        here, left, right = (self.cells(middle + off) for off in (0 * aside, -aside, aside))
        found = self.changed[here] - np.maximum(self.changed[left], self.changed[right])
        if (before := self.body[here]).any():
            own, one, other = (self.colors[y[before], x[before]] for y, x in (here, left, right))
            sides = [np.linalg.norm(own - side, axis=-1) for side in (one, other)]
            stands_out = np.minimum(np.minimum(*sides) / STANDS_OUT, 1.0)
            if self.color is not None:
                stands_out *= np.exp(-(((own - self.color) / HALF) ** 2).sum(-1))
            found[before] = stands_out if self.on_body else LEAST
        size = np.array(self.body.shape[::-1])
        inside = ((middle >= 0) & (middle < size)).all(-1)  # beyond it nothing is known
        return np.where(inside, found, LEAST), here


@dataclass(frozen=True)
class Fan:
    """Lines that begin beside a hand, by their angles and how far they pass beside its middle."""

    hand: Float[np.ndarray, "2"]
    angles: Float[np.ndarray, " N"]
    offs: Float[np.ndarray, " N"]

    @classmethod
    def of(cls, hand: np.ndarray, angles: np.ndarray, offs: np.ndarray) -> Fan:
        """Each of the angles with each of the offsets."""
        every = np.meshgrid(angles, offs, indexing="ij")
        return cls(hand, every[0].ravel(), every[1].ravel())

    def only(self, rows: Bool[np.ndarray, " N"]) -> Fan:
        return Fan(self.hand, self.angles[rows], self.offs[rows])

    @property
    def across(self) -> Float[np.ndarray, "N 2"]:
        return np.stack((-np.sin(self.angles), np.cos(self.angles)), -1)

    @property
    def starts(self) -> Float[np.ndarray, "N 2"]:
        return self.hand + self.offs[:, None] * self.across

    def best(self, look: Look, least: float = 0.0) -> Line:
        """The line with most evidence, which ends where evidence does, but not before `least`."""
        total, ends = self.sums(look, least)
        row = int(total.argmax())
        found, (y, x) = look.evidence(self.starts[[row]], self.angles[[row]])
        here = slice(0, int(ends[row]) + 1)
        free = ~look.body[y[0, here], x[0, here]]
        own = look.colors[y[0, here], x[0, here]][free]
        return Line(
            self.starts[row], float(self.angles[row]), STEP * float(ends[row]), float(total[row]),
            float((found[0, here][free] > LEAST).sum() / len(free)),
            np.median(own, 0) if len(own) else np.zeros(3),
        )  # fmt: skip

    def sums(
        self, look: Look, least: float = 0.0
    ) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"]]:
        """Most evidence of each line up to any end, and the step where it ends."""
        total = np.cumsum(look.evidence(self.starts, self.angles)[0] - LEAST, -1) * STEP
        total[:, : int(max(least, 0) / STEP)] = -np.inf
        ends = total.argmax(-1)
        return total[np.arange(len(ends)), ends], ends
