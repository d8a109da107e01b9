"""Error against parameters: one panel a ladder, its rungs as points, the chosen one marked."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from hoigs.studies.chart_labels import Box
from hoigs.studies.chart_names import settle
from hoigs.studies.chart_style import PALETTE, QUIET, STYLE, ink_of, is_log, short_number
from hoigs.studies.needs.search import Answer, Needs, Step

WIDTH, HEIGHT = 4.3, 3.5  # inches of a panel
COLUMNS, DPI = 3, 130
TRIED, TAKEN = PALETTE[0], PALETTE[1]


def draw(needs: Needs, *paths: Path) -> None:
    """Write the plot to every path, in the format of its suffix."""
    with matplotlib.rc_context(STYLE):
        figure = _figure(needs)
        for path in paths:
            figure.savefig(path, format=path.suffix.removeprefix("."), dpi=DPI)


def _figure(needs: Needs) -> Figure:
    answers = [a for a in needs.answers if any(s.score for s in a.steps)]
    columns = max(1, min(COLUMNS, len(answers)))
    rows = max(1, math.ceil(len(answers) / columns))
    figure = Figure(figsize=(columns * WIDTH, rows * HEIGHT), layout="constrained", dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(
        f"What {needs.clip} needs: error on training frames held back, by trained parameters",
        weight="bold",
    )
    panels = []
    for number, answer in enumerate(answers, 1):
        axes = figure.add_subplot(rows, columns, number)
        _panel(axes, answer)
        panels.append((axes, answer))
    figure.supxlabel(
        "trained parameters of the trial (a star: what was taken; pale: given up on the way, after "
        "fewer steps)",
        size=8.5, color=QUIET,
    )  # fmt: skip
    canvas.draw()
    figure.set_layout_engine("none")  # labels are placed where everything stands now
    for axes, answer in panels:
        _name(axes, answer)
    return figure


def _panel(axes: Axes, answer: Answer) -> None:
    """One ladder's points and axes."""
    shown = _shown(answer)
    longest = max(s.steps for s in shown)
    for step in shown:
        parameters, error, spread = _point(step)
        taken = step.rung is answer.chosen
        axes.errorbar(
            [parameters], [error], yerr=[spread], capsize=2, color=TAKEN if taken else TRIED,
            marker="*" if taken else "o", markersize=13 if taken else 6,
            alpha=1.0 if step.steps == longest else 0.45, zorder=3,
        )  # fmt: skip
    axes.set_title(answer.title, size=10, loc="left")
    axes.set_ylabel("RMSE, grey levels of 255", size=8)
    axes.tick_params(labelsize=8, which="both")
    axes.margins(x=0.3, y=0.25)
    _scale(axes, [_point(s)[0] for s in shown], [_point(s)[1] for s in shown])


def _scale(axes: Axes, parameters: list[int], errors: list[float]) -> None:
    """Logarithmic where that is easier to read; numbers as people say them."""
    for axis, scale, values in (
        (axes.xaxis, axes.set_xscale, parameters),
        (axes.yaxis, axes.set_yscale, errors),
    ):
        if is_log(values):
            scale("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=7))
            axis.set_minor_locator(NullLocator())
        else:
            axis.set_major_locator(MaxNLocator(5))
        axis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))


def _name(axes: Axes, answer: Answer) -> None:
    """The rungs' names, where nothing else is."""
    shown = _shown(answer)
    spots = [
        (float(x), float(y)) for x, y in axes.transData.transform([_point(s)[:2] for s in shown])
    ]
    texts = [
        axes.text(
            *_point(s)[:2], s.rung.name, size=8, zorder=4,
            color=ink_of(TAKEN if s.rung is answer.chosen else TRIED),
            weight="bold" if s.rung is answer.chosen else "normal",
        )
        for s in shown
    ]  # fmt: skip
    r = 7 * DPI / 72  # of a star
    points = [Box(x - r, y - r, x + r, y + r) for x, y in spots]
    settle(axes, texts, spots, points, leaders=[QUIET] * len(texts))


def _shown(answer: Answer) -> list[Step]:
    return [s for s in answer.steps if s.score is not None]


def _point(step: Step) -> tuple[int, float, float]:
    """Parameters, RMSE over the region, and its change by one standard error of the paired
    difference to the chosen rung (0 for that one itself)."""
    assert step.score is not None
    error = 255 * math.sqrt(step.score.mse)
    spread = step.over_chosen.error if step.over_chosen else 0.0
    return step.score.parameters, error, error * (10 ** (spread / 20) - 1)
