"""What a chart is drawn from: one cell a training, one point a method; plain data from JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean
from typing import Any, Literal

from hoigs.core.errors import HoigsError
from hoigs.evaluation.protocol import NotComputed, Value, from_json, to_json
from hoigs.studies.jobs.results import ALL_CLIPS, Spread
from hoigs.studies.plots import color_of, marker_of

FORMAT, VERSION = "hoigs-chart", 1


@dataclass(frozen=True)
class Axis:
    """One measure of a cell.

    Attributes:
        name: in JSON and CSV. title: on paper. better: which way is good.
        digits: shown in tables. timed: another machine gives another number.
    """

    name: str
    title: str
    better: Literal["higher", "lower"]
    digits: int = 2
    timed: bool = False

    def no_worse(self, a: float, b: float) -> bool:
        return a >= b if self.better == "higher" else a <= b


ACCURACY = (
    Axis("psnr_human_object", "PSNR, human + object (dB)", "higher"),
    Axis("psnr_full", "PSNR, full frame (dB)", "higher"),
    Axis("lpips_human_object", "LPIPS, human + object", "lower", 4),
    Axis("lpips_full", "LPIPS, full frame", "lower", 4),
)
COST = (
    Axis("train_s", "training (s)", "lower", 1, timed=True),
    Axis("render_ms", "rendering a frame (ms)", "lower", 2, timed=True),
    Axis("parameters", "parameters", "lower", 0),
    Axis("megabytes", "size (MB)", "lower", 2),
    Axis("joules", "training (J)", "lower", 0, timed=True),
    Axis("memory_mb", "peak memory of training (MB)", "lower", 0, timed=True),
)
AXES = {axis.name: axis for axis in (*ACCURACY, *COST)}
TIMED = {axis.name for axis in COST if axis.timed}
UNEVEN = "more trainings ran at a time for some clips than for others"
CurvePoint = tuple[int, float, float]  # step, seconds of training, dB


@dataclass(frozen=True)
class Cell:
    """One training of one spec on one clip.

    Attributes:
        spec: its label. definition: the spec's name or file, and its overrides.
        rasterizer: name. steps: the budget. clip: label. seed: of the training.
        run: its folder, relative to the chart's. machine: fingerprint in words, "" if never run.
        values: by axis name; every further number of the evaluation as "VIEW/REGION/METRIC".
        protocol: how the values were measured, in sentences.
        curve: PSNR of a few test frames as training went.
        missing: why there are no values; "" when there are.
        table: of the paper, that the spec is a row of; "" for specs that were chosen freely.
        at_once: how many trainings ran on the machine at a time.
    """

    spec: str
    definition: str
    rasterizer: str
    steps: int
    clip: str
    seed: int
    run: str = ""
    machine: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)
    protocol: tuple[str, ...] = ()
    curve: tuple[CurvePoint, ...] = ()
    missing: str = ""
    table: str = ""
    at_once: int = 1

    def to_dict(self) -> dict[str, Any]:
        plain = {name: to_json(v) for name, v in self.values.items()}
        return vars(self) | {"values": plain, "protocol": list(self.protocol),
                             "curve": [list(p) for p in self.curve]}  # fmt: skip

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Cell:
        values = {name: from_json(v) for name, v in data["values"].items()}
        curve = tuple((int(s), float(t), float(q)) for s, t, q in data["curve"])
        return Cell(**{**data, "values": values, "protocol": tuple(data["protocol"]),
                       "curve": curve})  # fmt: skip


@dataclass(frozen=True)
class Point:
    """The seeds of one spec, rasterizer and budget, on one clip and one machine.

    Attributes:
        values: mean and spread over `seeds`, by axis name; what is timed over `timed_seeds`, those
            that ran beside the fewest others.
        missing: why further seeds have none. curve: mean over seeds.
    """

    spec: str
    definition: str
    rasterizer: str
    steps: int
    clip: str
    machine: str
    seeds: tuple[int, ...]
    values: Mapping[str, Spread | NotComputed]
    protocol: tuple[str, ...]
    curve: tuple[CurvePoint, ...]
    missing: Mapping[int, str]
    timed_seeds: tuple[int, ...]
    table: str = ""

    def number(self, axis: Axis) -> float | None:
        value = self.values.get(axis.name)
        return value.mean if isinstance(value, Spread) else None

    def known(self, axis: Axis) -> float:
        """The number, which is there."""
        value = self.number(axis)
        assert value is not None, f"{self.spec} has no {axis.name}"
        return value

    def spread(self, axis: Axis) -> float:
        """Standard deviation over seeds; 0 with a single seed."""
        value = self.values.get(axis.name)
        return value.std or 0.0 if isinstance(value, Spread) else 0.0

    def seeds_of(self, axis: Axis) -> int:
        """How many seeds the number is a mean over."""
        value = self.values.get(axis.name)
        return len(value.values) if isinstance(value, Spread) else 0

    @property
    def timed_sentence(self) -> str:
        """Which seeds the times are of, where they are not of all; else empty."""
        if self.timed_seeds == self.seeds:
            return ""
        one, named = len(self.timed_seeds) == 1, ", ".join(map(str, self.timed_seeds))
        return (
            f"Times, joules and memory are of seed{'' if one else 's'} {named}; the others ran "
            "with more trainings at a time."
        )


def points_of(cells: Sequence[Cell]) -> list[Point]:
    """Cells of one spec, rasterizer, budget, clip and machine become a point, in order."""
    groups: dict[tuple[str | int, ...], list[Cell]] = {}
    for cell in cells:
        if not cell.missing:
            key = (*_method(cell), cell.clip, cell.machine)
            groups.setdefault(key, []).append(cell)
    return [_point(own, cells) for own in groups.values()]


def _point(own: Sequence[Cell], cells: Sequence[Cell]) -> Point:
    first = own[0]
    missing = {
        c.seed: c.missing
        for c in cells
        if c.missing and _method(c) == _method(first) and c.clip == first.clip
    }
    alone = [c for c in own if c.at_once == min(c.at_once for c in own)]
    names = dict.fromkeys(name for cell in own for name in cell.values)
    values = {
        name: _over([c.values.get(name) for c in (alone if name in TIMED else own)])
        for name in names
    }
    return Point(
        first.spec, first.definition, first.rasterizer, first.steps, first.clip, first.machine,
        tuple(c.seed for c in own), values, alone[0].protocol,
        mean_curve([c.curve for c in alone]), missing, tuple(c.seed for c in alone), first.table,
    )  # fmt: skip


def _method(cell: Cell) -> tuple[str, str, str, int]:
    return cell.table, cell.spec, cell.rasterizer, cell.steps


def _over(values: Sequence[Value | None]) -> Spread | NotComputed:
    numbers = [v for v in values if v is not None and not isinstance(v, NotComputed)]
    if len(numbers) == len(values):
        return Spread.of(numbers)
    reasons = sorted({v.reason for v in values if isinstance(v, NotComputed)})
    return NotComputed("; ".join(reasons) or "this run has no such number")


def mean_curve(curves: Sequence[Sequence[CurvePoint]]) -> tuple[CurvePoint, ...]:
    """Mean seconds and dB at each step that every seed has."""
    by_step = [{step: (s, q) for step, s, q in curve} for curve in curves]
    shared = sorted(set(by_step[0]).intersection(*by_step[1:])) if by_step else []
    return tuple(
        (step, mean(c[step][0] for c in by_step), mean(c[step][1] for c in by_step))
        for step in shared
    )


def all_clips(cells: Sequence[Cell]) -> list[Cell]:
    """Each seed's mean over clips, of what has been run on every clip by one machine.

    A number that one clip lacks is not computed, with that clip's reason; nor are costs where clips
    were trained with different numbers of trainings at a time.
    """
    clips = list(dict.fromkeys(c.clip for c in cells))
    groups: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells:
        if not cell.missing:
            key = (*_method(cell), cell.machine, cell.seed)
            groups.setdefault(key, []).append(cell)
    merged = []
    for own in groups.values():
        if {c.clip for c in own} == set(clips):
            names = dict.fromkeys(name for cell in own for name in cell.values)
            values = {name: _clip_mean(own, name) for name in names}
            if len({c.at_once for c in own}) > 1:
                values |= dict.fromkeys(TIMED & set(names), NotComputed(UNEVEN))
            protocol = tuple(f"{c.clip}: {' '.join(c.protocol)}" for c in own)
            merged.append(replace(own[0], clip=ALL_CLIPS, run="", values=values, protocol=protocol,
                                  curve=(), at_once=max(c.at_once for c in own)))  # fmt: skip
    return merged


def _clip_mean(cells: Sequence[Cell], name: str) -> Value:
    numbers = []
    for cell in cells:
        value = cell.values.get(name, NotComputed("this run has no such number"))
        if isinstance(value, NotComputed):
            return NotComputed(f"{cell.clip}: {value.reason}")
        numbers.append(value)
    return mean(numbers)


def dump_cells(cells: Sequence[Cell], about: Mapping[str, Any]) -> str:
    """chart.json, whole: `load_chart` reads it back."""
    points = [_plain_point(p) for p in points_of(cells)]
    data = {"format": FORMAT, "version": VERSION, "about": dict(about),
            "cells": [c.to_dict() for c in cells], "points": points}  # fmt: skip
    return json.dumps(data, indent=1, allow_nan=False)


def load_chart(path: Path) -> tuple[list[Cell], dict[str, Any]]:
    """The cells of a chart.json, and how they were made.

    Raises:
        HoigsError: the file is not one.
    """
    try:
        data = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise HoigsError(f"{path}: expected the chart.json of another chart: {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise HoigsError(f"{path}: not a chart.json; `hoigs study compare` writes one")
    if data["version"] != VERSION:
        raise HoigsError(f"{path}: version {data['version']} of a chart; this hoigs has {VERSION}")
    return [Cell.from_dict(cell) for cell in data["cells"]], data["about"]


def _plain_point(point: Point) -> dict[str, Any]:
    values = {
        name: to_json(v)
        if isinstance(v, NotComputed)
        else {"mean": v.mean, "std": v.std, "n": len(v.values)}
        for name, v in point.values.items()
    }
    return vars(point) | {
        "seeds": list(point.seeds), "timed_seeds": list(point.timed_seeds),
        "values": values, "protocol": list(point.protocol),
        "curve": [list(p) for p in point.curve],
        "missing": {str(seed): why for seed, why in point.missing.items()},
    }  # fmt: skip


def merged_about(abouts: Mapping[Path, Mapping[str, Any]]) -> dict[str, Any]:
    """How the added charts were made: once what all share, with the file's path what differs."""
    kinds = list(dict.fromkeys(kind for about in abouts.values() for kind in about))
    merged: dict[str, Any] = {}
    for kind in kinds:
        found = {path: about[kind] for path, about in abouts.items() if kind in about}
        if len(found) == len(abouts) and len({str(value) for value in found.values()}) == 1:
            merged[kind] = next(iter(found.values()))
        else:
            merged |= {f"{kind} ({path})": value for path, value in found.items()}
    return merged


# Points of one spec, rasterizer and machine, at any budgets: an entry of the legend.


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
        name = name_of(own[0], points)
        found.append(Series(name, color_of(color), marker_of(marker), ordered))
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


# Pareto front of points on two axes, and which points dominate which on several axes.
#
# Pure functions over points. Means are compared; where the seeds' spread is larger than what
# separates two points, a dominance is called unsure.


@dataclass(frozen=True)
class Dominance:
    """`winner` is no worse on every axis and better on one at least.

    Attributes:
        sure: on every axis where they differ the lead is above the standard deviation, over
            seeds, of the difference; False where each has it of a single seed, and so no spread.
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
    return sorted(kept, key=lambda p: p.known(axes[0]))


def dominates(a: Point, b: Point, axes: Sequence[Axis]) -> bool:
    """No worse on all axes, better on one; False where either lacks a number."""
    if len(comparable((a, b), axes)) < 2:
        return False
    pairs = [(axis, a.known(axis), b.known(axis)) for axis in axes]
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
    for axis in axes:
        lead = abs(a.known(axis) - b.known(axis))
        several = max(a.seeds_of(axis), b.seeds_of(axis)) > 1
        if lead and not (several and lead > math.hypot(a.spread(axis), b.spread(axis))):
            return False
    return True


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
