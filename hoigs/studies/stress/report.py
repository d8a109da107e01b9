"""A study's files: stress.md, stress.json, and the figures of matrix and curves."""

from __future__ import annotations

import json
import math
import textwrap
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from hoigs.core.system.files import write_whole
from hoigs.studies.plots import DPI, INK, MARKERS, PALETTE, QUIET, STYLE, framed, short_number
from hoigs.studies.stress.capabilities import MEANING as HAS
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.verdict import (
    MEANING,
    Status,
    Table,
    Verdict,
    axis_title,
    in_short,
    rate_of,
    requirement_of,
)

FORMAT, VERSION = "hoigs-stress", 1
MARKS = {"pass": "✓", "fail": "✗", "nature": "◐", "not applicable": "–", "not run": "?"}


def write_stress(table: Table, out: Path) -> list[Path]:
    """All files, each whole or not at all; curves only if a sweep has run."""
    from hoigs.studies.plots import figure_files

    out.mkdir(parents=True, exist_ok=True)
    files: dict[str, bytes] = {
        "stress.json": as_json(table).encode(),
        "stress.md": as_markdown(table).encode(),
    }
    drawn = {"stress-matrix": matrix(table, "Where methods break"),
             "stress-curves": breakdown(table, "How hard until it breaks")}  # fmt: skip
    for name, figure in drawn.items():
        if figure is not None:
            files |= figure_files(name, figure)
    for name, content in files.items():
        write_whole(out / name, content)
    return [out / name for name in files]


def as_json(table: Table) -> str:
    """Everything, each seed and value on its own."""
    data = {
        "format": FORMAT,
        "version": VERSION,
        "about": dict(table.about),
        "machines": table.machines,
        "meaning": dict(MEANING),
        "specs": dict(table.definitions),
        "cases": [case.model_dump(mode="json") | {"kind": "sweep"} for case in table.cases],
        "verdicts": [v.to_dict() for v in table.verdicts.values()],
    }
    return json.dumps(data, indent=1, allow_nan=False)


def as_markdown(table: Table) -> str:
    """The matrix in words, then each case: requirement, results, and advice."""
    lines = ["# Where methods break", "", *(f"- {note}" for note in table.notes), ""]
    lines += [f"- {MARKS[status]} {status}: {words}" for status, words in MEANING.items()]
    for family, cases in table.families().items():
        lines += ["", f"## {family.capitalize()}", ""]
        lines += ["| | " + " | ".join(table.specs) + " |", "|---" * (len(table.specs) + 1) + "|"]
        for case in cases:
            cells = [_cell(case, table.at(case, spec)) for spec in table.specs]
            lines.append(f"| {case.id} {case.title} | {' | '.join(cells)} |")
        for case in cases:
            lines += ["", *_section(table, case)]
    shown = sorted({s for v in table.verdicts.values() for s in v.protocol})
    if shown:
        lines += ["", "## Protocol", "", *(f"- {sentence}" for sentence in shown)]
    return "\n".join(lines).rstrip() + "\n"


def _cell(case: Case, verdict: Verdict) -> str:
    rate = rate_of(verdict)
    words = [MARKS[verdict.status]]
    if verdict.seeds:
        words.append(in_short(case, verdict))
    return " ".join([*words, *([f"({rate})"] if rate else [])])


def _section(table: Table, case: Case) -> list[str]:
    lines = [f"### {case.id} {case.title}", "", f"Trigger: {case.trigger}. Passes: "
             f"{case.criterion}."]  # fmt: skip
    if case.concerns:
        lines[-1] += f" Concerns models with {', '.join(HAS[c] for c in case.concerns)}."
    values = ", ".join(f"{value:g}" for value in case.sweep.values)
    lines += ["", f"Values: {case.sweep.unit}: {values}; required: {requirement_of(case)}."]
    results: dict[str, list[str]] = {}
    for spec in table.specs:
        verdict = table.at(case, spec)
        if verdict.measured:
            results.setdefault(f"{verdict.status}: {verdict.measured}", []).append(spec)
    lines += ["", *(f"- {', '.join(specs)}: {words}" for words, specs in results.items())]
    failed = {"fail", "nature"} & {table.at(case, spec).status for spec in table.specs}
    if failed and case.advice:
        lines += ["", f"What to do: {case.advice}."]
    return lines


# Breakdown curves: a score against the value of a sweep, for each method.

PANEL, LEGEND = (3.9, 3.3), 2.2  # inches
MOST_COLUMNS = 4


def breakdown(table: Table, title: str) -> Figure | None:
    """A panel for each case with a sweep that has been run; None where none has."""
    cases = [c for c in table.cases if any(table.curve(c, spec) for spec in table.specs)]
    if not cases:
        return None
    columns = min(MOST_COLUMNS, len(cases))
    rows = math.ceil(len(cases) / columns)
    width = PANEL[0] * max(2, columns) + LEGEND
    with matplotlib.rc_context(STYLE):
        figure = framed(title, [HOW, *table.notes], width, PANEL[1] * rows)
        grid: Any = figure.subplots(rows, columns, squeeze=False)
        for axes, case in zip_longest(grid.flat, cases):
            if case is None:
                axes.axis("off")
            else:
                _panel(axes, table, case)
        looks = [
            Line2D([], [], color=_color(i), marker=_marker(i)) for i in range(len(table.specs))
        ]
        figure.legend(looks, table.specs, loc="outside right upper")
    return figure


HOW = (
    "Bars: one standard deviation over seeds. A cross: half of the seeds or more fail that "
    "value; a seed that fails a value runs none harder. Grey line: the required value."
)


def _panel(axes: Any, table: Table, case: Case) -> None:
    sweep = case.sweep
    places = {value: i for i, value in enumerate(sweep.values)}
    axes.axvline(places[sweep.required_value], color="#c3c8ce", linewidth=1.2, zorder=0)
    for i, spec in enumerate(table.specs):
        points = table.curve(case, spec)
        if not points:
            continue
        shift = 0.05 * (i - (len(table.specs) - 1) / 2)  # so that bars do not hide each other
        x, spreads = [places[value] + shift for value in points], points.values()
        axes.errorbar(
            x, [s.mean for s in spreads], yerr=[s.std or 0 for s in spreads], color=_color(i),
            marker=_marker(i), markersize=4.5, linewidth=1.4, elinewidth=0.9, capsize=0, zorder=3,
        )  # fmt: skip
        broken = table.at(case, spec).breaks_at
        if broken in points:
            axes.plot(places[broken] + shift, points[broken].mean, "x", color=INK, markersize=9,
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


# The matrix: cases down, specs across, a colour for each verdict.

ROW, COLUMN = 0.25, 1.22  # inches of a cell
LEFT, RIGHT, MATRIX_LINE = 4.5, 0.3, 0.19  # inches of the titles, the margin, a line of notes
NARROWEST = 9.6  # inches at which the legend has two lines
MATRIX_HEAD, GAP = 1.2, 0.36  # inches above the first row, and above each family

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
    height = MATRIX_HEAD + body + 0.45 + MATRIX_LINE * len(notes)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), dpi=DPI)
        FigureCanvasAgg(figure)
        axes: Any = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, width), ylim=(height, 0))
        axes.axis("off")
        _head(axes, table, title, width)
        y = MATRIX_HEAD
        for family, cases in families.items():
            y += GAP
            axes.text(0.3, y - 0.1, family.capitalize(), size=10.5, weight="bold", va="center")
            for case in cases:
                _row(axes, table, case, y)
                y += ROW
        for i, line in enumerate(notes):
            axes.text(0.3, y + 0.35 + MATRIX_LINE * i, line, size=8, color=QUIET, va="center")
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
        axes.text(LEFT + COLUMN * (i + 0.5), MATRIX_HEAD + 0.22, "\n".join(lines), size=9,
                  weight="bold",
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
