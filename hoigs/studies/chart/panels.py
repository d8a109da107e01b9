"""Accuracy against cost: one matplotlib figure a clip, a panel for each pair of axes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from hoigs.studies.chart.data import ACCURACY, COST, Axis, Point
from hoigs.studies.chart.pareto import comparable, front, usable_axes
from hoigs.studies.chart.series import Series, machine_sentences, machines, series_of
from hoigs.studies.plotting.style import DPI, FRONT, QUIET, STYLE, is_log, short_number

PANEL = (2.6, 2.2)  # inches
MARKER = 7.0  # points


def accuracy_chart(
    points: Sequence[Point], title: str, *, mix_machines: bool = False
) -> Figure | None:
    """The figure of one clip's points; None when there is nothing to draw.

    Args:
        points: of one clip. title: of the figure.
        mix_machines: draw times although several machines measured them.
    """
    rows, no_rows = usable_axes(points, ACCURACY, mix_machines)
    columns, no_columns = usable_axes(points, COST, mix_machines)
    if not rows or not columns:
        return None
    series = series_of(points)
    notes = foot_notes(points, no_rows | no_columns)
    with matplotlib.rc_context(STYLE):
        figure = framed(title, points, notes, PANEL[0] * max(2, len(columns)), PANEL[1] * len(rows))
        grid: Any = figure.subplots(len(rows), len(columns), squeeze=False, sharex="col",
                                    sharey="row")  # fmt: skip
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                _panel(grid[i][j], series, column, row)
            if row.better == "lower":
                grid[i][0].invert_yaxis()
            grid[i][0].yaxis.set_major_locator(MaxNLocator(5))
            grid[i][0].set_ylabel(row.title + (", reversed" if row.better == "lower" else ""))
        for axes, column in zip(grid[-1], columns, strict=True):
            scale(axes, [v for p in points if (v := p.number(column)) is not None])
            axes.set_xlabel(column.title)
        handles, names = grid[0][0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside right upper")
        figure.align_ylabels(grid[:, 0])
    return figure


def framed(
    title: str, points: Sequence[Point], notes: Sequence[str], width: float, height: float
) -> Figure:
    """A figure with title and notes, and `width` x `height` inches for its panels."""
    several = len(machines(points)) > 1
    text = f"{title}: points of {len(machines(points))} machines" if several else title
    width += 2.2  # of the legend
    lines = [line for note in notes for line in textwrap.wrap(note, int(width * 15))]
    size = (width, height + 0.9 + 0.16 * len(lines))
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(text, x=0.01, ha="left", size=14, weight="bold")
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", size=8.5, color=QUIET)
    return figure


def foot_notes(points: Sequence[Point], absent: Mapping[str, str]) -> list[str]:
    """What stands below a figure: machines, budgets, seeds, and what is absent and why."""
    seeds = sorted({len(p.seeds) for p in points})
    steps = sorted({p.steps for p in points})
    protocol = textwrap.shorten(" ".join(points[0].protocol[:1]), 150, placeholder=" …")
    notes = [f"Up and left is better. {protocol}", *machine_sentences(points)]
    spread = "bars: one standard deviation over seeds" if seeds[-1] > 1 else "no spread: one seed"
    notes.append(
        f"{' to '.join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))} "
        f"seed{'s' if seeds[-1] > 1 else ''} a point ({spread}). Filled markers are on the "
        "Pareto front."
        + (f" Larger markers: more steps ({', '.join(map(str, steps))})." if len(steps) > 1
           else f" {steps[0]} steps.")
    )  # fmt: skip
    lost = [f"{p.spec} seed {s}: {why}" for p in points for s, why in p.missing.items()]
    notes += [f"Missing: {'; '.join(lost)}."] if lost else []
    notes += [f"{name}: {why}." for name, why in absent.items()]
    return notes


def _panel(axes: Axes, series: Sequence[Series], cost: Axis, accuracy: Axis) -> None:
    pair = (cost, accuracy)
    best = front([p for s in series for p in s.points], pair)
    if len(best) > 1:
        axes.step([_at(p, cost) for p in best], [_at(p, accuracy) for p in best], where="post",
                  label="Pareto front", color=FRONT, linewidth=1.2, linestyle="--",
                  zorder=1)  # fmt: skip
    steps = sorted({p.steps for s in series for p in s.points})
    for one in series:
        shown = comparable(one.points, pair)
        axes.plot([_at(p, cost) for p in shown], [_at(p, accuracy) for p in shown],
                  color=one.color, linewidth=1.0, alpha=0.45, zorder=2)  # fmt: skip
        for point in shown:
            on_front = any(point is p for p in best)
            axes.errorbar(
                _at(point, cost), _at(point, accuracy), xerr=point.spread(cost) or None,
                yerr=point.spread(accuracy) or None, color=one.color, elinewidth=1.0,
                marker=one.marker, markersize=MARKER * (steps.index(point.steps) + 3)
                / (len(steps) + 2), markerfacecolor=one.color if on_front else "white",
                markeredgewidth=1.4, linestyle="none", zorder=4 if on_front else 3,
            )  # fmt: skip
        axes.plot([], [], one.marker, color=one.color, label=one.name, markersize=MARKER)
    axes.margins(0.12, 0.14)
    axes.tick_params(length=0)


def _at(point: Point, axis: Axis) -> float:
    value = point.number(axis)
    assert value is not None
    return value


def scale(axes: Axes, values: Sequence[float]) -> None:
    """The horizontal axis: logarithmic where that is easier to read, with short numbers."""
    if is_log(values):
        axes.set_xscale("log")
        decades = max(values) / min(values)
        subs = (1, 2, 5) if decades < 60 else (1, 3) if decades < 600 else (1,)
        axes.xaxis.set_major_locator(LogLocator(subs=subs))
        axes.xaxis.set_minor_locator(NullLocator())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))
