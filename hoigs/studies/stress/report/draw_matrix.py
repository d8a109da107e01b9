"""The matrix: cases down, specs across, a colour for each verdict."""

from __future__ import annotations

import textwrap
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hoigs.studies.plotting.style import INK, QUIET, STYLE
from hoigs.studies.stress.report.table import Table, in_short, rate_of
from hoigs.studies.stress.verdict import MEANING, Status

DPI = 160
ROW, COLUMN = 0.25, 1.22  # inches of a cell
LEFT, RIGHT, LINE = 4.5, 0.3, 0.19  # inches of the titles, the margin, a line of notes
NARROWEST = 9.6  # inches at which the legend has two lines
HEAD, GAP = 1.2, 0.36  # inches above the first row, and above each family

# fill and ink, dark enough to be read on it (WCAG AA)
COLORS: dict[Status, tuple[str, str]] = {
    "pass": ("#bfe5d6", "#0b4a36"),
    "fail": ("#f3b79a", "#6b2400"),
    "nature": ("#fbe3b0", "#5a4300"),
    "not applicable": ("#f3f4f5", "#686f78"),
    "not run": ("#ffffff", "#686f78"),
}


def matrix(table: Table, title: str) -> Figure:
    """One row for each case, by family, and a verdict in each cell."""
    families = table.families()
    width = max(NARROWEST, LEFT + COLUMN * len(table.specs) + RIGHT)
    notes = [line for note in table.notes for line in textwrap.wrap(note, int(width * 15))]
    body = sum(GAP + ROW * len(cases) for cases in families.values())
    height = HEAD + body + 0.45 + LINE * len(notes)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI)
        FigureCanvasAgg(figure)
        axes: Any = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, width), ylim=(height, 0))
        axes.axis("off")
        _head(axes, table, title, width)
        y = HEAD
        for family, cases in families.items():
            y += GAP
            axes.text(0.3, y - 0.1, family.capitalize(), size=10.5, weight="bold", va="center")
            for case in cases:
                _row(axes, table, case, y)
                y += ROW
        for i, line in enumerate(notes):
            axes.text(0.3, y + 0.35 + LINE * i, line, size=8, color=QUIET, va="center")
    return figure


def _head(axes: Any, table: Table, title: str, width: float) -> None:
    axes.text(0.3, 0.38, title, size=15, weight="bold", va="center")
    counts = {s: sum(v.status == s for v in table.verdicts.values()) for s in COLORS}
    x, y = 0.3, 0.76
    for status, (fill, _) in COLORS.items():
        words = f"{status}: {MEANING[status]} ({counts[status]})"
        if x > 0.3 and x + 0.3 + 0.066 * len(words) > width:
            x, y = 0.3, y + 0.21
        axes.add_patch(Rectangle((x, y - 0.07), 0.16, 0.14, facecolor=fill, edgecolor="#9aa0a8",
                                 linewidth=0.5))  # fmt: skip
        axes.text(x + 0.23, y, words, size=8.5, color=QUIET, va="center")
        x += 0.45 + 0.066 * len(words)
    for i, spec in enumerate(table.specs):
        lines = textwrap.wrap(spec.replace("@", " @"), 12)
        axes.text(LEFT + COLUMN * (i + 0.5), HEAD + 0.22, "\n".join(lines), size=9, weight="bold",
                  ha="center", va="bottom")  # fmt: skip


def _row(axes: Any, table: Table, case: Any, y: float) -> None:
    middle = y + ROW / 2
    axes.text(0.3, middle, case.id, size=8.5, color=QUIET, va="center")
    shown = textwrap.shorten(case.title, 56, placeholder=" …")
    axes.text(0.72, middle, shown, size=9, color=INK, va="center")
    for i, spec in enumerate(table.specs):
        verdict = table.at(case, spec)
        fill, ink = COLORS[verdict.status]
        box = (LEFT + COLUMN * i + 0.02, y + 0.015)
        hatch = "////" if verdict.status == "not run" else None
        axes.add_patch(Rectangle(box, COLUMN - 0.04, ROW - 0.03, facecolor=fill, hatch=hatch,
                                 edgecolor="#d5d8dc", linewidth=0.5))  # fmt: skip
        rate = rate_of(verdict)
        words = in_short(case, verdict) + (f" · {rate}" if rate else "")
        axes.text(LEFT + COLUMN * (i + 0.5), middle, words, size=7.6, color=ink, ha="center",
                  va="center")  # fmt: skip
