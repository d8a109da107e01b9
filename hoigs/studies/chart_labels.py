"""Where labels go so that none covers a point, a line's end or another label. Pixels; pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

SWEEPS = 6  # labels are placed one by one, then again in view of where the others went
REACHES = (9.0, 16.0, 26.0, 40.0, 58.0, 80.0)  # from a point to its label, pixels


@dataclass(frozen=True)
class Box:
    """Lower left and upper right corner."""

    x0: float
    y0: float
    x1: float
    y1: float

    def overlap(self, other: Box) -> float:
        """Shared area, square pixels."""
        width = min(self.x1, other.x1) - max(self.x0, other.x0)
        height = min(self.y1, other.y1) - max(self.y0, other.y0)
        return max(0.0, width) * max(0.0, height)

    def outside(self, bounds: Box) -> float:
        """Area that lies outside of `bounds`, square pixels."""
        area = (self.x1 - self.x0) * (self.y1 - self.y0)
        return area - self.overlap(bounds)


@dataclass(frozen=True)
class Placed:
    """A label's box, and whether it is far enough from its point to need a line to it."""

    box: Box
    leader: bool


def place(
    anchors: Sequence[tuple[float, float]],
    sizes: Sequence[tuple[float, float]],
    obstacles: Sequence[Box],
    bounds: Box,
    segments: Sequence[tuple[tuple[float, float], tuple[float, float]]] = (),
) -> list[Placed]:
    """A box of each size near its anchor, within bounds, over as little else as can be.

    Args:
        anchors: points that are labelled. sizes: width and height of each label.
        obstacles: what should stay visible. segments: lines that labels had better not cross.
    """
    lines = [_beads(a, b) for a, b in segments]
    strokes = np.concatenate(lines) if lines else np.zeros((0, 2))
    options = [_options(anchor, size) for anchor, size in zip(anchors, sizes, strict=True)]
    fixed = [
        [_fixed_cost(box, reach, obstacles, bounds, strokes) for box, reach in own]
        for own in options
    ]
    chosen = [min(range(len(own)), key=costs.__getitem__) for own, costs in zip(options, fixed)]
    for _ in range(SWEEPS):
        before = list(chosen)
        for i, own in enumerate(options):
            others = [options[j][chosen[j]][0] for j in range(len(options)) if j != i]
            cost = [
                at + 8 * sum(box.overlap(o) for o in others)
                for (box, _), at in zip(own, fixed[i], strict=True)
            ]
            chosen[i] = min(range(len(own)), key=cost.__getitem__)
        if chosen == before:
            break
    return [
        Placed(own[i][0], own[i][1] > REACHES[1]) for own, i in zip(options, chosen, strict=True)
    ]


def _options(anchor: tuple[float, float], size: tuple[float, float]) -> list[tuple[Box, float]]:
    """Boxes around a point in 16 directions at each reach."""
    (x, y), (width, height) = anchor, size
    found = []
    for reach in REACHES:
        for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
            dx, dy = float(np.cos(angle)), float(np.sin(angle))
            # the box's nearest side, not its middle, is at the reach
            left = x + reach * dx - width * (0.5 - 0.5 * _side(dx))
            low = y + reach * dy - height * (0.5 - 0.5 * _side(dy))
            found.append((Box(left, low, left + width, low + height), reach))
    return found


def _side(part: float) -> float:
    """-1, 0 or 1: a direction's part, with nearly straight ones as straight."""
    return 0.0 if abs(part) < 0.25 else float(np.sign(part))


def _fixed_cost(
    box: Box, reach: float, obstacles: Sequence[Box], bounds: Box, strokes: np.ndarray
) -> float:
    inside = (
        (strokes[:, 0] > box.x0) & (strokes[:, 0] < box.x1)
        & (strokes[:, 1] > box.y0) & (strokes[:, 1] < box.y1)
    )  # fmt: skip
    return (
        6 * sum(box.overlap(o) for o in obstacles)
        + 40 * box.outside(bounds)
        + 12.0 * float(inside.sum())
        + 2.5 * reach
    )


def _beads(a: tuple[float, float], b: tuple[float, float], step: float = 4.0) -> np.ndarray:
    """Points along a line, so that crossing it can be counted."""
    count = max(2, int(np.hypot(b[0] - a[0], b[1] - a[1]) / step))
    return np.linspace(a, b, count)


def spread_out(wanted: Sequence[float], height: float, low: float, high: float) -> list[float]:
    """Heights near the wanted ones, in their order, `height` apart, from `low` to `high`.

    Labels at the ends of curves: one column, so that only the vertical is free. Where there is no
    room for all they are squeezed evenly.
    """
    if not wanted:
        return []
    gap = min(height, (high - low) / max(1, len(wanted) - 1)) if len(wanted) > 1 else height
    order = sorted(range(len(wanted)), key=wanted.__getitem__)
    placed = [min(max(wanted[i], low), high) for i in order]
    for _ in range(200):
        moved = 0.0
        for i, j in pairwise(range(len(placed))):
            short = gap - (placed[j] - placed[i])
            if short > 1e-6:
                placed[i], placed[j] = placed[i] - short / 2, placed[j] + short / 2
                moved = max(moved, short)
        placed = [min(max(v, low), high) for v in placed]
        if moved < 1e-3:
            break
    out = [0.0] * len(wanted)
    for rank, i in enumerate(order):
        out[i] = placed[rank]
    return out
