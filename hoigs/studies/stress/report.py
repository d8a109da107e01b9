"""A study's files: stress.md, stress.json, and the figures of matrix and curves."""

from __future__ import annotations

import json
import math
import textwrap
from collections import Counter
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hoigs.core.system.files import write_whole
from hoigs.studies.plots import (
    INK,
    QUIET,
    STYLE,
    color_of,
    figure_files,
    framed,
    marker_of,
    short_number,
)
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
MARKS = {"pass": "✓", "fail": "✗", "limitation": "◐", "not applicable": "–", "not run": "?"}


def write_stress(table: Table, out: Path) -> list[Path]:
    """All files, each whole or not at all; curves only if a sweep has run."""
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
    failed = {"fail", "limitation"} & {table.at(case, spec).status for spec in table.specs}
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
        every = range(len(table.specs))
        looks = [Line2D([], [], color=color_of(i), marker=marker_of(i)) for i in every]
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
            x, [s.mean for s in spreads], yerr=[s.std or 0 for s in spreads], color=color_of(i),
            marker=marker_of(i), markersize=4.5, linewidth=1.4, elinewidth=0.9, capsize=0, zorder=3,
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


# The matrix: cases down, specs across, a colour for each verdict.

ROW, COLUMN = 0.25, 1.22  # inches of a cell
TITLES, HEAD, GAP = 4.5, 1.0, 0.42  # inches of titles, of specs and legend, above each family
NARROWEST = 9.6  # inches at which the legend has two columns

# fill and ink, dark enough to be read on it (WCAG AA)
COLORS: dict[Status, tuple[str, str]] = {
    "pass": ("#bfe5d6", "#0b4a36"),
    "fail": ("#f3b79a", "#6b2400"),
    "limitation": ("#fbe3b0", "#5a4300"),
    "not applicable": ("#f3f4f5", "#686f78"),
    "not run": ("#ffffff", "#686f78"),
}


def matrix(table: Table, title: str) -> Figure:
    """One row for each case, by family, and a verdict in each cell."""
    families = table.families()
    rows = [len(cases) for cases in families.values()]
    width = max(NARROWEST, TITLES + COLUMN * len(table.specs))
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = framed(title, table.notes, width, HEAD + ROW * sum(rows) + GAP * len(rows))
        grid: Any = figure.subplots(len(rows), squeeze=False, height_ratios=rows)[:, 0]
        for axes, (family, cases) in zip(grid, families.items(), strict=True):
            _family(axes, table, family, cases)
        specs = ["\n".join(textwrap.wrap(spec.replace("@", " @"), 12)) for spec in table.specs]
        grid[0].tick_params(labeltop=True)
        grid[0].set_xticks(range(len(specs)), specs, weight="bold", color=INK)
        counts = Counter(verdict.status for verdict in table.verdicts.values())
        keys = [
            Patch(facecolor=fill, edgecolor="#9aa0a8", label=f"{s}: {MEANING[s]} ({counts[s]})")
            for s, (fill, _) in COLORS.items()
        ]
        at = (1, 0)  # below the last row
        grid[-1].legend(handles=keys, loc="upper right", bbox_to_anchor=at, ncols=2)
    return figure


def _family(axes: Any, table: Table, family: str, cases: Sequence[Case]) -> None:
    verdicts = [[table.at(case, spec) for spec in table.specs] for case in cases]
    fills = [[to_rgb(COLORS[verdict.status][0]) for verdict in row] for row in verdicts]
    axes.imshow(fills, aspect="auto")
    titles = [f"{case.id}  {textwrap.shorten(case.title, 56, placeholder=' …')}" for case in cases]
    axes.set_yticks(range(len(cases)), titles, color=INK)
    axes.set_xticks([])
    axes.set_xticks(np.arange(0.5, len(table.specs)), minor=True)
    axes.set_yticks(np.arange(0.5, len(cases)), minor=True)
    axes.grid(which="minor", color="white", linewidth=2)
    axes.tick_params(which="both", length=0, labelbottom=False)
    axes.spines[:].set_visible(False)
    axes.set_title(family.capitalize(), loc="right", x=-0.01, size=10.5, weight="bold")
    for y, (case, row) in enumerate(zip(cases, verdicts, strict=True)):
        for x, verdict in enumerate(row):
            rate = rate_of(verdict)
            words = in_short(case, verdict) + (f" · {rate}" if rate else "")
            ink = COLORS[verdict.status][1]
            axes.text(x, y, words, size=7.6, color=ink, ha="center", va="center")
