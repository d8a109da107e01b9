"""Error against parameters: a panel for each search space, its candidates as points."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from hoigs.studies.needs.result import Answer, Needs, Step
from hoigs.studies.plotting.style import MARKERS, PALETTE, QUIET, STYLE, is_log, short_number

WIDTH, HEIGHT = 4.8, 3.0  # inches of a panel
COLUMNS, DPI = 3, 130


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
    FigureCanvasAgg(figure)
    figure.suptitle(
        f"What {needs.clip} needs: error on training frames held back, by trained parameters",
        weight="bold",
    )
    for number, answer in enumerate(answers, 1):
        _panel(figure.add_subplot(rows, columns, number), answer)
    figure.supxlabel(
        "trained parameters of the trial (star: chosen; pale: rejected early, after fewer steps)",
        size=8.5, color=QUIET,
    )  # fmt: skip
    return figure


def _panel(axes: Axes, answer: Answer) -> None:
    """Points and axes of one search space."""
    shown = _shown(answer)
    longest = max(s.steps for s in shown)
    for i, step in enumerate(shown):
        parameters, error, spread = _point(step)
        taken = step.candidate is answer.chosen
        axes.errorbar(
            [parameters], [error], yerr=[spread], capsize=2, color=PALETTE[i % len(PALETTE)],
            marker="*" if taken else MARKERS[i % len(MARKERS)], markersize=13 if taken else 6,
            alpha=1.0 if step.steps == longest else 0.45, zorder=3, linestyle="none",
            label=step.candidate.name,
        )  # fmt: skip
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    axes.set_title(answer.title, size=10, loc="left")
    axes.set_ylabel("RMSE, grey levels of 255", size=8)
    axes.tick_params(labelsize=8, which="both")
    axes.margins(0.15)
    _scale(axes, [_point(s)[0] for s in shown], [_point(s)[1] for s in shown])


def _scale(axes: Axes, parameters: list[int], errors: list[float]) -> None:
    """Logarithmic axes where values spread widely, with short numbers."""
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


def _shown(answer: Answer) -> list[Step]:
    return [s for s in answer.steps if s.score is not None]


def _point(step: Step) -> tuple[int, float, float]:
    """Parameters, RMSE over the region, and its change by one standard error of the paired
    difference to the chosen candidate (0 for that one itself)."""
    assert step.score is not None
    error = 255 * math.sqrt(step.score.mse)
    spread = step.over_chosen.error if step.over_chosen else 0.0
    return step.score.parameters, error, error * (10 ** (spread / 20) - 1)
