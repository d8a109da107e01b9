"""Error against parameters: one panel a ladder, its rungs as points, the chosen one marked."""

from __future__ import annotations

import math
from pathlib import Path

from hoigs.studies.needs.search import Answer, Needs, Step

WIDTH, HEIGHT = 3.6, 3.0  # inches of a panel
COLUMNS = 3
SPAN = 4.0


def draw(needs: Needs, *paths: Path) -> None:
    """Write the plot to every path, in the format of its suffix."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    answers = [a for a in needs.answers if any(s.score for s in a.steps)]
    columns = max(1, min(COLUMNS, len(answers)))
    rows = max(1, math.ceil(len(answers) / columns))
    figure = Figure(figsize=(columns * WIDTH, rows * HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{needs.clip}: error on training frames held back")
    for place, answer in enumerate(answers, 1):
        _panel(figure.add_subplot(rows, columns, place), answer)
    for path in paths:
        figure.savefig(path, format=path.suffix.removeprefix("."), dpi=130)


def _panel(axes: object, answer: Answer) -> None:
    from matplotlib.axes import Axes

    assert isinstance(axes, Axes)
    shown = [s for s in answer.steps if s.score is not None]
    longest = max(s.steps for s in shown)
    for step in shown:
        parameters, error, spread = _point(step)
        taken = step.rung is answer.chosen
        axes.errorbar(
            [parameters], [error], yerr=[spread], capsize=2, color="C3" if taken else "C0",
            marker="*" if taken else "o", markersize=11 if taken else 5,
            alpha=1.0 if step.steps == longest else 0.45,
        )  # fmt: skip
        axes.annotate(
            step.rung.name, (parameters, error), textcoords="offset points", xytext=(5, 4),
            fontsize=6.5,
        )  # fmt: skip
    block = answer.block
    name = answer.ladder.name
    axes.set_title(name if block in ("", name) else f"{name} of {block}", fontsize=9)
    counts = [s.score.parameters for s in shown if s.score]
    if max(counts) > SPAN * min(counts):  # over less, logarithmic ticks cannot be read
        axes.set_xscale("log")
    else:
        axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 4))
        axes.locator_params(axis="x", nbins=4)
    axes.margins(x=0.3, y=0.15)
    axes.set_xlabel("trained parameters (of the trial)", fontsize=7)
    axes.set_ylabel("RMSE, grey levels of 255", fontsize=7)
    axes.tick_params(labelsize=6, which="both")


def _point(step: Step) -> tuple[int, float, float]:
    """Parameters, RMSE over the region, and its change by one standard error of the paired
    difference to the chosen rung (0 for that one itself)."""
    assert step.score is not None
    error = 255 * math.sqrt(step.score.mse)
    spread = step.over_chosen.error if step.over_chosen else 0.0
    return step.score.parameters, error, error * (10 ** (spread / 20) - 1)
