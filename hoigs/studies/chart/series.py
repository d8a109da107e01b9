"""Points of one spec, rasterizer and machine, at any budgets: an entry of the legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hoigs.studies.chart.data import Point
from hoigs.studies.plotting.style import MARKERS, PALETTE


@dataclass(frozen=True)
class Series:
    """One entry of the legend.

    Attributes:
        name: the spec, with rasterizer and machine where they differ between series.
        color, marker: of matplotlib. points: fewest steps first.
    """

    name: str
    color: str
    marker: str
    points: tuple[Point, ...]


def series_of(points: Sequence[Point]) -> list[Series]:
    """Series in order of appearance. The colour is the spec's; so is the marker, unless there are
    several rasterizers or machines: then it is theirs."""
    specs = list(dict.fromkeys(p.spec for p in points))
    groups: dict[tuple[str, str, str], list[Point]] = {}
    for p in points:
        groups.setdefault((p.spec, p.rasterizer, p.machine), []).append(p)
    setups = list(dict.fromkeys((rasterizer, machine) for _, rasterizer, machine in groups))
    found = []
    for (spec, *setup), own in groups.items():
        color = specs.index(spec)
        marker = setups.index((setup[0], setup[1])) if len(setups) > 1 else color
        ordered = tuple(sorted(own, key=lambda p: p.steps))
        found.append(Series(name_of(own[0], points), PALETTE[color % len(PALETTE)],
                            MARKERS[marker % len(MARKERS)], ordered))  # fmt: skip
    return found


def name_of(point: Point, points: Sequence[Point], steps: bool = False) -> str:
    """A point's name among these: rasterizer, machine and `steps` only where they differ."""
    words, found = [point.spec], machines(points)
    if len({p.rasterizer for p in points}) > 1:
        words.append(point.rasterizer)
    if len(found) > 1:
        words.append(f"machine {letter(found.index(point.machine))}")
    if steps and len({p.steps for p in points}) > 1:
        words.append(f"{point.steps} steps")
    return ", ".join(words)


def machines(points: Sequence[Point]) -> list[str]:
    """Descriptions of the machines, sorted: a machine has one letter however points are ordered."""
    return sorted({p.machine for p in points})


def machine_sentences(points: Sequence[Point]) -> list[str]:
    """Which machine measured the points, or that there are several, and which is which."""
    found = machines(points)
    if len(found) == 1:
        return [f"Measured on {found[0]}."]
    each = [f"machine {letter(i)}: {words}" for i, words in enumerate(found)]
    differ = "times, joules and memory cannot be compared between them"
    return [f"Points of {len(found)} machines; {differ}.", *each]


def letter(index: int) -> str:
    """Machine A, B … Z, then A1, B1 …"""
    return chr(ord("A") + index % 26) + (str(index // 26) if index >= 26 else "")
