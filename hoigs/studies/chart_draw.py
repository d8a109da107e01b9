"""Accuracy against cost, on paper: one figure a clip, a panel for each pair of axes."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from hoigs.studies.chart_data import ACCURACY, COST, Axis, Point
from hoigs.studies.chart_front import comparable, front, machines, usable_axes
from hoigs.studies.chart_labels import Box
from hoigs.studies.chart_names import settle
from hoigs.studies.chart_style import (
    INK,
    QUIET,
    STYLE,
    colors_of,
    ink_of,
    is_log,
    letter,
    markers_of,
    short_number,
)

PANEL = (4.3, 3.6)  # inches
HEAD, FOOT = 1.15, 0.35  # inches above, and below before any line of notes
LINE = 0.2  # inches a line of notes
DPI = 160
MARKER_RADIUS = 5.0  # points


@dataclass(frozen=True)
class Labelled:
    """A figure and where its labels are, pixels, panel by panel; for the tests."""

    figure: Figure
    labels: Sequence[Sequence[Box]]


def accuracy_chart(
    points: Sequence[Point], title: str, *, mix_machines: bool = False
) -> Labelled | None:
    """The figure of one clip's points; None when there is nothing to draw.

    Args:
        points: of one clip. title: of the figure.
        mix_machines: draw times although several machines measured them.
    """
    rows, no_rows = usable_axes(points, ACCURACY, mix_machines)
    columns, no_columns = usable_axes(points, COST, mix_machines)
    if not rows or not columns:
        return None
    notes = foot_notes(points, no_rows | no_columns)
    width = PANEL[0] * max(2, len(columns))
    wrapped = [line for note in notes for line in textwrap.wrap(note, int(width * 16))]
    foot = FOOT + LINE * len(wrapped) + LINE * len(markers_of(points))
    height = HEAD + PANEL[1] * len(rows) + foot
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI)
        canvas = FigureCanvasAgg(figure)
        grid: Any = figure.subplots(len(rows), len(columns), squeeze=False)
        figure.subplots_adjust(
            left=0.75 / width, right=1 - 0.25 / width, top=1 - HEAD / height,
            bottom=(foot + 0.5) / height, wspace=0.24, hspace=0.3,
        )  # fmt: skip
        _head(figure, points, title, width, height)
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                _panel(grid[i][j], points, column, row)
        _foot(figure, points, wrapped, width, height)
        canvas.draw()
        labels = [_label(axes, points, column, row)
                  for axes, column, row in _panels(grid, columns, rows)]  # fmt: skip
        canvas.draw()
    return Labelled(figure, labels)


def _panels(
    grid: Any, columns: Sequence[Axis], rows: Sequence[Axis]
) -> Iterator[tuple[Axes, Axis, Axis]]:
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            yield grid[i][j], column, row


def machine_sentences(points: Sequence[Point]) -> list[str]:
    """Which machine, or that there are several, and which is which."""
    found = machines(points)
    if len(found) == 1:
        return [f"Measured on {found[0]}."]
    each = [f"machine {letter(i)}: {words}" for i, words in enumerate(found)]
    return [f"Points of {len(found)} machines; times and joules cannot be compared between them.",
            *each]  # fmt: skip


def foot_notes(points: Sequence[Point], absent: dict[str, str]) -> list[str]:
    """What stands below a figure: machines, budgets, seeds, and what is not there and why."""
    seeds = sorted({len(p.seeds) for p in points})
    steps = sorted({p.steps for p in points})
    notes = [*machine_sentences(points)]
    spread = "bars: one standard deviation over seeds" if seeds[-1] > 1 else "no spread: one seed"
    notes.append(
        f"{' to '.join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))} "
        f"seed{'s' if seeds[-1] > 1 else ''} a point ({spread}). Grey steps: Pareto front; filled "
        "markers are on it."
        + (f" Larger markers: more steps ({', '.join(map(str, steps))})." if len(steps) > 1
           else f" {steps[0]} steps.")
    )  # fmt: skip
    lost = [f"{p.spec} seed {s}: {why}" for p in points for s, why in p.missing.items()]
    notes += [f"Missing: {'; '.join(lost)}."] if lost else []
    notes += [f"{name}: {why}." for name, why in absent.items()]
    return notes


def _head(figure: Figure, points: Sequence[Point], title: str, width: float, height: float) -> None:
    several = len(machines(points)) > 1
    text = f"{title}: points of {len(machines(points))} machines" if several else title
    left = 0.75 / width
    figure.text(left, 1 - 0.34 / height, text, size=15, weight="bold", va="center")
    how = "Up and left is better."
    if points[0].protocol:
        how += " " + points[0].protocol[0]
    shown = textwrap.shorten(how, int(width * 13), placeholder=" …")
    figure.text(left, 1 - 0.64 / height, shown, size=9.5, color=QUIET, va="center")


def _foot(
    figure: Figure, points: Sequence[Point], notes: Sequence[str], width: float, height: float
) -> None:
    left, y = 0.75 / width, (LINE * (len(notes) + len(markers_of(points))) + 0.1) / height
    found = machines(points)
    for (rasterizer, machine), marker in markers_of(points).items():
        text = f"rasterizer:{rasterizer}"
        if len(found) > 1:
            text += f" on machine {letter(found.index(machine))}"
        artist = Line2D([left + 0.06 / width], [y], marker=marker, color=QUIET, markersize=6,
                        transform=figure.transFigure)  # fmt: skip
        figure.add_artist(artist)
        figure.text(left + 0.2 / width, y, text, size=9, color=INK, va="center")
        y -= LINE / height
    for line in notes:
        figure.text(left, y, line, size=8.5, color=QUIET, va="center")
        y -= LINE / height


def _panel(axes: Axes, points: Sequence[Point], cost: Axis, accuracy: Axis) -> None:
    colors, markers = colors_of(points), markers_of(points)
    shown = comparable(points, (cost, accuracy))
    best = front(shown, (cost, accuracy))
    steps = sorted({p.steps for p in points})
    for line in _lines(shown):
        axes.plot([_at(p, cost) for p in line], [_at(p, accuracy) for p in line],
                  color=colors[line[0].spec], linewidth=1.0, alpha=0.45, zorder=2)  # fmt: skip
    if len(best) > 1:
        axes.step([_at(p, cost) for p in best], [_at(p, accuracy) for p in best], where="post",
                  color="#8a9099", linewidth=1.3, linestyle=(0, (4, 2)), zorder=1)  # fmt: skip
    for point in shown:
        color = colors[point.spec]
        on_front = any(point is p for p in best)
        size = 2 * MARKER_RADIUS * (0.68 + 0.32 * (steps.index(point.steps) + 1) / len(steps))
        axes.errorbar(
            _at(point, cost), _at(point, accuracy), xerr=_bar(point, cost),
            yerr=_bar(point, accuracy), color=color, ecolor=color, elinewidth=1.0, capsize=0,
            marker=markers[point.rasterizer, point.machine], markersize=size,
            markerfacecolor=color if on_front else "white", markeredgecolor=color,
            markeredgewidth=1.5, zorder=4 if on_front else 3,
        )  # fmt: skip
    _scale(axes, [_at(p, cost) for p in shown])
    axes.yaxis.set_major_locator(MaxNLocator(6))
    if accuracy.better == "lower":
        axes.invert_yaxis()
    axes.margins(0.2, 0.16)
    axes.tick_params(length=0, labelsize=9)
    axes.set_xlabel(cost.title)
    arrow = ", axis turned round" if accuracy.better == "lower" else ""
    axes.set_title(accuracy.title + arrow, loc="left", size=10, weight="bold", color=INK)


def _at(point: Point, axis: Axis) -> float:
    value = point.number(axis)
    assert value is not None
    return value


def _bar(point: Point, axis: Axis) -> float | None:
    return point.spread(axis) or None


def _lines(points: Sequence[Point]) -> list[list[Point]]:
    """One method's budgets, in order, joined."""
    groups: dict[tuple[str, str, str], list[Point]] = {}
    for p in points:
        groups.setdefault((p.spec, p.rasterizer, p.machine), []).append(p)
    return [sorted(own, key=lambda p: p.steps) for own in groups.values()]


def _scale(axes: Axes, values: Sequence[float]) -> None:
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))
    if not is_log(values):
        axes.xaxis.set_major_locator(MaxNLocator(5))
        return
    axes.set_xscale("log")
    decades = max(values) / min(values)
    subs = (1, 2, 5) if decades < 60 else (1, 3) if decades < 600 else (1,)
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _label(axes: Axes, points: Sequence[Point], cost: Axis, accuracy: Axis) -> list[Box]:
    """Name each spec once, at its largest budget, where nothing else is; markers tell the rest."""
    colors = colors_of(points)
    shown = comparable(points, (cost, accuracy))
    lines = _lines(shown)
    named = list({line[-1].spec: line[-1] for line in reversed(lines)}.values())

    def pixels(p: Point) -> tuple[float, float]:
        x, y = axes.transData.transform((_at(p, cost), _at(p, accuracy)))
        return float(x), float(y)

    pixel = DPI / 72
    paper = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.6}
    texts = [
        axes.text(_at(p, cost), _at(p, accuracy), p.spec, size=8.5, weight="bold", zorder=2.5,
                  color=ink_of(colors[p.spec]), bbox=paper)
        for p in named
    ]  # fmt: skip
    r = (MARKER_RADIUS + 1) * pixel
    markers = [Box(x - r, y - r, x + r, y + r) for x, y in map(pixels, shown)]
    strokes = [(pixels(a), pixels(b)) for line in lines for a, b in pairwise(line)]
    strokes += list(_bars(axes, shown, cost, accuracy))
    strokes += list(_stairs([pixels(p) for p in front(shown, (cost, accuracy))]))
    leaders = [colors[p.spec] for p in named]
    return settle(axes, texts, list(map(pixels, named)), markers, strokes, leaders=leaders)


def _stairs(
    spots: Sequence[tuple[float, float]],
) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """The front's steps: along, then up."""
    for (x0, y0), (x1, y1) in pairwise(spots):
        yield (x0, y0), (x1, y0)
        yield (x1, y0), (x1, y1)


def _bars(
    axes: Axes, points: Sequence[Point], cost: Axis, accuracy: Axis
) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Error bars, as lines that labels keep off."""
    for p in points:
        x, y, dx, dy = _at(p, cost), _at(p, accuracy), p.spread(cost), p.spread(accuracy)
        ends = [(x, y - dy), (x, y + dy)]
        if x > dx:  # a bar that reaches zero has no end on a logarithmic axis
            ends += [(x - dx, y), (x + dx, y)]
        spots = [tuple(map(float, e)) for e in axes.transData.transform(ends)]
        for a, b in zip(spots[::2], spots[1::2], strict=True):
            yield (a[0], a[1]), (b[0], b[1])
