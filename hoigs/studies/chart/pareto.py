"""Pareto front of points on two axes, and which points dominate which on several axes.

Pure functions over points. Means are compared; where the seeds' spread is larger than what
separates two points, a dominance is called unsure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from hoigs.studies.chart.data import Axis, Point
from hoigs.studies.chart.series import machines


@dataclass(frozen=True)
class Dominance:
    """`winner` is no worse on every axis and better on one at least.

    Attributes:
        sure: on every axis where they differ the lead is above the standard deviation, over
            seeds, of the difference; False where each point has a single seed, and so no spread.
    """

    winner: Point
    loser: Point
    sure: bool


def comparable(points: Sequence[Point], axes: Sequence[Axis]) -> list[Point]:
    """Those that have a number on every axis."""
    return [p for p in points if all(p.number(axis) is not None for axis in axes)]


def front(points: Sequence[Point], axes: Sequence[Axis]) -> list[Point]:
    """Points that no other dominates, cheapest (by the first axis) first."""
    found = comparable(points, axes)
    kept = [p for p in found if not any(dominates(q, p, axes) for q in found if q is not p)]
    return sorted(kept, key=lambda p: _known(p, axes[0]))


def dominates(a: Point, b: Point, axes: Sequence[Axis]) -> bool:
    """No worse on all axes, better on one; False where either lacks a number."""
    if len(comparable((a, b), axes)) < 2:
        return False
    pairs = [(axis, _known(a, axis), _known(b, axis)) for axis in axes]
    return all(axis.no_worse(x, y) for axis, x, y in pairs) and any(x != y for _, x, y in pairs)


def dominances(points: Sequence[Point], axes: Sequence[Axis]) -> list[Dominance]:
    """Every pair of which one dominates the other."""
    return [
        Dominance(a, b, _sure(a, b, axes))
        for b in points
        for a in points
        if a is not b and dominates(a, b, axes)
    ]


def _sure(a: Point, b: Point, axes: Sequence[Axis]) -> bool:
    if len(a.seeds) < 2 and len(b.seeds) < 2:
        return False
    leads = [(axis, abs(_known(a, axis) - _known(b, axis))) for axis in axes]
    return all(
        lead == 0 or lead > math.hypot(a.spread(axis), b.spread(axis)) for axis, lead in leads
    )


def _known(point: Point, axis: Axis) -> float:
    value = point.number(axis)
    assert value is not None, f"{point.spec} has no {axis.name}"
    return value


def usable_axes(
    points: Sequence[Point], axes: Sequence[Axis], mix_machines: bool
) -> tuple[list[Axis], dict[str, str]]:
    """Axes that can be drawn, and why the others cannot, by their title.

    Axes of time and energy are left out for points of several machines, unless `mix_machines`.
    """
    kept, refused = [], {}
    several = len(machines(points)) > 1
    for axis in axes:
        having = [p for p in points if p.number(axis) is not None]
        if not having:
            reasons = {str(p.values[axis.name]) for p in points if axis.name in p.values}
            refused[axis.title] = "; ".join(sorted(reasons)) or "not computed: no run is done"
        elif several and axis.timed and not mix_machines:
            refused[axis.title] = (
                f"not drawn: measured on {len(machines(points))} machines, whose times cannot be "
                "compared; --mix-machines draws it all the same"
            )
        else:
            kept.append(axis)
    return kept, refused
