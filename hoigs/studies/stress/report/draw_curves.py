"""Breakdown curves: a score against the value of a sweep, for each method."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hoigs.studies.plotting.style import INK, MARKERS, PALETTE, QUIET, STYLE, short_number
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.report.table import Table, axis_title

DPI = 160
PANEL = (3.9, 3.1)  # inches
MOST_COLUMNS = 4
HEAD, LINE = 1.05, 0.19


def breakdown(table: Table, title: str) -> Figure | None:
    """A panel for each case with a sweep that has been run; None where none has."""
    cases = [c for c in table.cases if c.sweep is not None and _drawn(table, c)]
    if not cases:
        return None
    columns = min(MOST_COLUMNS, len(cases))
    rows = math.ceil(len(cases) / columns)
    width = PANEL[0] * max(2, columns)
    notes = [line for note in [HOW, *table.notes] for line in textwrap.wrap(note, int(width * 15))]
    legend = math.ceil(len(table.specs) / max(1, int(width / 1.9)))
    foot = 0.5 + LINE * len(notes)
    head = HEAD + 0.24 * (legend - 1)
    height = head + PANEL[1] * rows + foot
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI)
        FigureCanvasAgg(figure)
        grid: Any = figure.subplots(rows, columns, squeeze=False)
        figure.subplots_adjust(
            left=0.62 / width, right=1 - 0.2 / width, top=1 - (head + 0.25) / height,
            bottom=(foot + 0.5) / height, wspace=0.24, hspace=0.52,
        )  # fmt: skip
        for i, case in enumerate(cases):
            _panel(grid[i // columns][i % columns], table, case)
        for i in range(len(cases), rows * columns):
            grid[i // columns][i % columns].axis("off")
        figure.text(0.3 / width, 1 - 0.34 / height, title, size=15, weight="bold", va="center")
        _legend(figure, table.specs, width, height)
        for i, line in enumerate(notes):
            figure.text(0.3 / width, (foot - 0.3 - LINE * i) / height, line, size=8, color=QUIET,
                        va="center")  # fmt: skip
    return figure


HOW = (
    "Bars: one standard deviation over seeds. A cross: half of the seeds or more fail that "
    "value; a seed that fails a value runs none harder. Grey line: the required value."
)


def _drawn(table: Table, case: Case) -> bool:
    return any(table.curve(case, spec) for spec in table.specs)


def _legend(figure: Figure, specs: Sequence[str], width: float, height: float) -> None:
    x, y = 0.36, 0.68
    for i, spec in enumerate(specs):
        step = 0.42 + 0.078 * len(spec)
        if x + step > width - 0.2:
            x, y = 0.36, y + 0.24
        artist = Line2D([x / width, (x + 0.22) / width], [1 - y / height] * 2, color=_color(i),
                        marker=_marker(i), markersize=5, linewidth=1.4,
                        transform=figure.transFigure)  # fmt: skip
        figure.add_artist(artist)
        figure.text((x + 0.3) / width, 1 - y / height, spec, size=9, color=INK, va="center")
        x += step + 0.1


def _panel(axes: Any, table: Table, case: Case) -> None:
    sweep = case.sweep
    assert sweep is not None
    places = {value: i for i, value in enumerate(sweep.values)}
    axes.axvline(places[sweep.required_value], color="#c3c8ce", linewidth=1.2, zorder=0)
    for i, spec in enumerate(table.specs):
        points = table.curve(case, spec)
        if not points:
            continue
        shift = 0.05 * (i - (len(table.specs) - 1) / 2)  # so that bars do not hide each other
        x = [places[p.value] + shift for p in points]
        axes.errorbar(
            x, [p.mean for p in points], yerr=[p.std or 0 for p in points], color=_color(i),
            marker=_marker(i), markersize=4.5, linewidth=1.4, elinewidth=0.9, capsize=0, zorder=3,
        )  # fmt: skip
        broken = table.at(case, spec).breaks_at
        at = [(a, p.mean) for a, p in zip(x, points, strict=True) if p.value == broken]
        axes.plot([a for a, _ in at], [b for _, b in at], "x", color=INK, markersize=9,
                  markeredgewidth=1.6, zorder=4)  # fmt: skip
    axes.set_xticks(list(places.values()), [short_number(v) for v in sweep.values])
    axes.set_xlim(-0.4, len(places) - 0.6)
    axes.tick_params(length=0, labelsize=8.5)
    axes.set_xlabel(sweep.unit, size=9)
    heading = textwrap.fill(f"{case.id} {case.title}", 44)
    axes.set_title(f"{heading}\n", loc="left", size=9.5, weight="bold", color=INK)
    axes.text(0, 1.03, axis_title(case), transform=axes.transAxes, size=8.5, color=QUIET)


def _color(index: int) -> str:
    return PALETTE[index % len(PALETTE)]


def _marker(index: int) -> str:
    return MARKERS[index % len(MARKERS)]
