"""Accuracy against cost: one matplotlib figure a clip, a panel for each pair of axes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hoigs.studies.compare.data import (
    ACCURACY,
    COST,
    Axis,
    Point,
    Series,
    comparable,
    front,
    machine_sentences,
    machines,
    series_of,
    usable_axes,
)
from hoigs.studies.plots import FRONT, STYLE, framed, scale

PANEL, LEGEND = (2.6, 2.2), 2.2  # inches
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
        width = PANEL[0] * max(2, len(columns)) + LEGEND
        figure = framed(_titled(title, points), notes, width, PANEL[1] * len(rows))
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
            scale(axes, "x", [v for p in points if (v := p.number(column)) is not None])
            axes.set_xlabel(column.title)
        handles, names = grid[0][0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside right upper")
        figure.align_ylabels(grid[:, 0])
    return figure


def _titled(title: str, points: Sequence[Point]) -> str:
    count = len(machines(points))
    return f"{title}: points of {count} machines" if count > 1 else title


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
    notes += [points[0].timed_sentence] if points[0].timed_sentence else []
    lost = [f"{p.spec} seed {s}: {why}" for p in points for s, why in p.missing.items()]
    notes += [f"Missing: {'; '.join(lost)}."] if lost else []
    notes += [f"{name}: {why}." for name, why in absent.items()]
    return notes


def _panel(axes: Axes, series: Sequence[Series], cost: Axis, accuracy: Axis) -> None:
    pair = (cost, accuracy)
    best = front([p for s in series for p in s.points], pair)
    if len(best) > 1:
        axes.step([p.known(cost) for p in best], [p.known(accuracy) for p in best], where="post",
                  label="Pareto front", color=FRONT, linewidth=1.2, linestyle="--",
                  zorder=1)  # fmt: skip
    steps = sorted({p.steps for s in series for p in s.points})
    for one in series:
        shown = comparable(one.points, pair)
        axes.plot([p.known(cost) for p in shown], [p.known(accuracy) for p in shown],
                  color=one.color, linewidth=1.0, alpha=0.45, zorder=2)  # fmt: skip
        for point in shown:
            on_front = any(point is p for p in best)
            axes.errorbar(
                point.known(cost), point.known(accuracy), xerr=point.spread(cost) or None,
                yerr=point.spread(accuracy) or None, color=one.color, elinewidth=1.0,
                marker=one.marker, markersize=MARKER * (steps.index(point.steps) + 3)
                / (len(steps) + 2), markerfacecolor=one.color if on_front else "white",
                markeredgewidth=1.4, linestyle="none", zorder=4 if on_front else 3,
            )  # fmt: skip
        axes.plot([], [], one.marker, color=one.color, label=one.name, markersize=MARKER)
    axes.margins(0.12, 0.14)
    axes.tick_params(length=0)


# Quality during training: PSNR of test frames over seconds and over steps, one line a series.


def curve_chart(
    points: Sequence[Point], title: str, *, mix_machines: bool = False
) -> Figure | None:
    """The largest budget of every series; None where no run has previews.

    The panel over seconds is left out when several machines measured them, unless `mix_machines`.
    """
    series = series_of([p for p in points if len(p.curve) > 1])
    if not series:
        return None
    # the legend has the order of the lines' ends
    series = sorted((replace(s, points=s.points[-1:]) for s in series),
                    key=lambda s: -s.points[0].curve[-1][2])  # fmt: skip
    shown = [s.points[0] for s in series]
    timed = mix_machines or len(machines(shown)) == 1
    axes_of = [(1, "seconds of training"), (0, "steps")] if timed else [(0, "steps")]
    notes = ["PSNR of at most four test frames, full frame, during training; mean over seeds. The "
             "legend has the order of the last values.", *machine_sentences(shown)]  # fmt: skip
    if not timed:
        notes.append("Seconds are not drawn: several machines; --mix-machines draws them.")
    with matplotlib.rc_context(STYLE):
        figure = framed(_titled(title, points), notes, 5.2 * len(axes_of) + LEGEND, 3.6)
        grid = figure.subplots(1, len(axes_of), squeeze=False, sharey=True)[0]
        for axes, (which, name) in zip(grid, axes_of, strict=True):
            for one in series:
                curve = one.points[0].curve
                axes.plot([c[which] for c in curve], [c[2] for c in curve], one.marker + "-",
                          color=one.color, linewidth=1.6, markersize=4, label=one.name)  # fmt: skip
            scale(axes, "x", [s.points[0].curve[-1][which] for s in series])
            axes.set_xlabel(name)
            axes.tick_params(length=0)
        grid[0].set_ylabel("PSNR, full frame (dB)")
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside right upper")
    return figure
