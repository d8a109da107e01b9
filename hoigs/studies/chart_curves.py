"""Quality as training goes: test frames' PSNR over seconds and over steps, one line a method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from hoigs.studies.chart_data import Point
from hoigs.studies.chart_draw import DPI, machine_sentences
from hoigs.studies.chart_front import machines
from hoigs.studies.chart_labels import spread_out
from hoigs.studies.chart_style import (
    QUIET,
    STYLE,
    colors_of,
    ink_of,
    names_of,
    short_number,
)

DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (2, 1.5)))  # matplotlib's
ROOM = 0.3  # of the width, for the labels at the lines' ends


def curve_chart(
    points: Sequence[Point], title: str, *, mix_machines: bool = False
) -> Figure | None:
    """The largest budget of every method; None where no run has previews.

    The panel over seconds is left out when several machines measured them, unless `mix_machines`.
    """
    shown = _longest([p for p in points if len(p.curve) > 1])
    if not shown:
        return None
    several = len(machines(shown)) > 1
    timed = not several or mix_machines
    axes_of = [(1, "seconds of training"), (0, "steps")] if timed else [(0, "steps")]
    notes = ["PSNR of at most four test frames, full frame, during training; mean over seeds.",
             *machine_sentences(shown)]  # fmt: skip
    if not timed:
        notes.append("Seconds are not drawn: several machines; --mix-machines draws them.")
    width, height = 6.6 * len(axes_of) + 0.4, 5.0 + 0.2 * len(notes)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI)
        canvas = FigureCanvasAgg(figure)
        grid = figure.subplots(1, len(axes_of), squeeze=False)[0]
        figure.subplots_adjust(left=0.75 / width, right=1 - 0.2 / width, top=1 - 0.8 / height,
                               bottom=(0.85 + 0.2 * len(notes)) / height, wspace=0.16)  # fmt: skip
        text = f"{title}: {len(machines(shown))} machines" if several else title
        figure.text(0.75 / width, 1 - 0.34 / height, text, size=15, weight="bold", va="center")
        for axes, (which, name) in zip(grid, axes_of, strict=True):
            _lines(axes, shown, which)
            axes.set_xlabel(name)
            axes.set_title("PSNR, full frame (dB)", loc="left", size=10, weight="bold")
        for i, note in enumerate(reversed(notes)):
            figure.text(0.75 / width, (0.15 + 0.2 * i) / height, note, size=8.5, color=QUIET)
        canvas.draw()
        for axes, (which, _) in zip(grid, axes_of, strict=True):
            _end_labels(axes, shown, which)
    return figure


def _longest(points: Sequence[Point]) -> list[Point]:
    """Of each method the point with most steps, in order."""
    best: dict[tuple[str, str, str], Point] = {}
    for p in points:
        key = (p.spec, p.rasterizer, p.machine)
        if key not in best or p.steps > best[key].steps:
            best[key] = p
    return list(best.values())


def _lines(axes: Axes, points: Sequence[Point], which: int) -> None:
    colors = colors_of(points)
    kinds = list(dict.fromkeys((p.rasterizer, p.machine) for p in points))
    for p in points:
        dash = DASHES[kinds.index((p.rasterizer, p.machine)) % len(DASHES)]
        axes.plot([c[which] for c in p.curve], [c[2] for c in p.curve], color=colors[p.spec],
                  linewidth=1.8, linestyle=dash, marker="o", markersize=3)  # fmt: skip
    ends = [p.curve[-1][which] for p in points]
    if which == 1 and min(ends) > 0 and max(ends) > 6 * min(ends):
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(NullLocator())
    low, high = axes.get_xlim()
    if axes.get_xscale() == "log":
        axes.set_xlim(low, high * (high / low) ** (ROOM / (1 - ROOM)))
    else:
        axes.set_xlim(max(0.0, low), high + (high - low) * ROOM / (1 - ROOM))
        axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))
    axes.tick_params(length=0)


def _end_labels(axes: Axes, points: Sequence[Point], which: int) -> None:
    """Names in a column right of the lines, each joined to the end of its own."""
    colors, names = colors_of(points), names_of(points)
    window = axes.get_window_extent()
    ends = [axes.transData.transform((p.curve[-1][which], p.curve[-1][2])) for p in points]
    column = window.x0 + (1 - ROOM + 0.04) * window.width
    column = max(column, max(float(x) for x, _ in ends) + 18)
    heights = spread_out([float(y) for _, y in ends], 12.5 * DPI / 72, window.y0 + 8, window.y1 - 8)
    invert = axes.transData.inverted()
    for i, (p, (x, y), height) in enumerate(zip(points, ends, heights, strict=True)):
        at = invert.transform([(x, y), (column - 4, height), (column, height)])
        axes.plot(at[:2, 0], at[:2, 1], color=colors[p.spec], linewidth=0.7, alpha=0.6,
                  scalex=False, scaley=False)  # fmt: skip
        axes.text(at[2, 0], at[2, 1], names[i], size=8.5, weight="bold", va="center",
                  color=ink_of(colors[p.spec]))  # fmt: skip
