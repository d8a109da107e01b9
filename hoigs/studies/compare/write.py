"""A chart's files: chart.json, chart.csv, chart.md, and figures of every clip."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hoigs.core.system.files import write_whole
from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.compare import paper
from hoigs.studies.compare.data import (
    ACCURACY,
    AXES,
    COST,
    Axis,
    Cell,
    Point,
    all_clips,
    dominances,
    dump_cells,
    front,
    machine_sentences,
    name_of,
    points_of,
    usable_axes,
)
from hoigs.studies.jobs.results import ALL_CLIPS, Spread
from hoigs.studies.plots import figure_files


def by_clip(cells: Sequence[Cell]) -> dict[str, list[Point]]:
    """Points of each clip that has any, then the mean of all where there are several; with the name
    of the paper's table where they are rows of one."""
    sheets: dict[str, list[Point]] = {}
    for table in dict.fromkeys(c.table for c in cells):
        rows = [c for c in cells if c.table == table]
        clips = list(dict.fromkeys(c.clip for c in rows))
        for clip in [*clips, ALL_CLIPS] if len(clips) > 1 else clips:
            own = all_clips(rows) if clip == ALL_CLIPS else [c for c in rows if c.clip == clip]
            sheets[f"{table}, {clip}" if table else clip] = points_of(own)
    return {clip: points for clip, points in sheets.items() if points}


def write_chart(
    cells: Sequence[Cell], out: Path, about: Mapping[str, Any], *, mix_machines: bool = False
) -> list[Path]:
    """All files, each whole or not at all; figures of a clip only where something can be drawn.

    Args:
        about: how the study was made, JSON values.
        mix_machines: draw times of several machines in one panel.
    """
    out.mkdir(parents=True, exist_ok=True)
    sheets = by_clip(cells)
    files: dict[str, bytes] = {
        "chart.json": dump_cells(cells, about).encode(),
        "chart.csv": as_csv(cells).encode(),
        "chart.md": markdown(cells, sheets, about, mix_machines).encode(),
    }
    for clip, points in sheets.items():
        files |= _figures(clip, points, mix_machines)
    for name, content in files.items():
        write_whole(out / name, content)
    return [out / name for name in files]


def _figures(clip: str, points: Sequence[Point], mix_machines: bool) -> dict[str, bytes]:
    from hoigs.studies.compare.panels import accuracy_chart, curve_chart

    stem = f"chart-{slug(clip)}"
    drawn = accuracy_chart(points, f"{clip}: accuracy against cost", mix_machines=mix_machines)
    curves = curve_chart(points, f"{clip}: quality during training", mix_machines=mix_machines)
    found: dict[str, bytes] = {}
    for name, figure in ((stem, drawn), (f"{stem}-curves", curves)):
        if figure is not None:
            found |= figure_files(name, figure)
    return found


def slug(name: str) -> str:
    """A clip's name as part of a file's."""
    return re.sub(r"[^\w.]+", "-", name).strip("-")


def as_csv(cells: Sequence[Cell]) -> str:
    """One number a line, every seed on its own, each with its protocol."""
    columns = ("table", "clip", "spec", "definition", "rasterizer", "steps", "seed", "measure",
               "value", "not_computed", "machine", "run", "protocol")  # fmt: skip
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for cell in cells:
        base = vars(cell) | {"protocol": " ".join(cell.protocol)}
        for name in dict.fromkeys((*AXES, *cell.values)):
            unknown = NotComputed(cell.missing or "this run has no such number")
            value = cell.values.get(name, unknown)
            absent = value.reason if isinstance(value, NotComputed) else ""
            number = "" if isinstance(value, NotComputed) else repr(value)
            writer.writerow(base | {"measure": name, "value": number, "not_computed": absent})
    return text.getvalue()


def markdown(
    cells: Sequence[Cell],
    sheets: Mapping[str, Sequence[Point]],
    about: Mapping[str, Any],
    mix_machines: bool,
) -> str:
    """Numbers and dominances, a section a clip."""
    lines = ["# Accuracy against cost", "", *(f"- {k}: {v}" for k, v in about.items()), ""]
    for clip, points in sheets.items():
        lines += [f"## {clip}", "", *(f"- {said}" for said in machine_sentences(points)), ""]
        lines += [*_grid([*ACCURACY, *COST], points), ""]
        lines += [*dominance_table(points, mix_machines), ""]
        if points[0].table:
            for title, axes in paper.columns(points):
                lines += [f"{title}:", "", *_grid(axes, points), ""]
            lines += paper.published_table(points[0].table)
        said = [*points[0].protocol, points[0].timed_sentence]
        lines += ["Protocol:", "", *(f"- {s}" for s in said if s), ""]
    lost = [c for c in cells if c.missing]
    if lost:
        lines += ["## Not run or failed", ""]
        lines += [
            f"- {c.spec}, {c.clip}, {c.steps} steps, seed {c.seed}: {c.missing}" for c in lost
        ]
    return "\n".join(lines).rstrip() + "\n"


def _grid(axes: Sequence[Axis], points: Sequence[Point]) -> list[str]:
    notes: dict[str, int] = {}
    lines = ["| | steps | seeds | " + " | ".join(a.title for a in axes) + " |",
             "|---" * (len(axes) + 3) + "|"]  # fmt: skip
    for p in points:
        cells = [_shown(p, axis, notes) for axis in axes]
        lines.append(f"| {name_of(p, points)} | {p.steps} | {len(p.seeds)} | {' | '.join(cells)} |")
    lines += ["", "± is the sample standard deviation over seeds.  "]
    return [*lines, *(f"({n}) not computed: {reason}  " for reason, n in notes.items())]


def _shown(point: Point, axis: Axis, notes: dict[str, int]) -> str:
    value = point.values.get(axis.name, NotComputed("this run has no such number"))
    if not isinstance(value, Spread):
        return f"– ({notes.setdefault(value.reason, len(notes) + 1)})"
    spread = "" if value.std is None else f" ± {value.std:,.{axis.digits}f}"
    return f"{value.mean:,.{axis.digits}f}{spread}"


def dominance_table(points: Sequence[Point], mix_machines: bool) -> list[str]:
    """For each cost, and for all at once, by whom a point is dominated; Markdown lines."""
    rows, _ = usable_axes(points, ACCURACY, mix_machines)
    columns, refused = usable_axes(points, COST, mix_machines)
    if not rows or not columns:
        return ["Nothing to compare: no accuracy or no cost is computed."]
    sets: dict[str, tuple[Axis, ...]] = {
        f"{rows[0].title} against {c.title}": (c, rows[0]) for c in columns
    }
    sets["everything that is computed"] = (*columns, *rows)
    lines = ["Who dominates: no worse on every axis of the column and better on one. (?): on some "
             "axis by less than one standard deviation over seeds, or of single seeds.", "",
             "| | " + " | ".join(sets) + " |", "|---" * (len(sets) + 1) + "|"]  # fmt: skip
    found = {name: (dominances(points, axes), front(points, axes)) for name, axes in sets.items()}
    for p in points:
        cells = []
        for pairs, best in found.values():
            winners = [f"{name_of(d.winner, points, True)}{'' if d.sure else ' (?)'}"
                       for d in pairs if d.loser is p]  # fmt: skip
            on_front = any(p is q for q in best)
            cells.append("**front**" if on_front else "; ".join(winners) or "–")
        lines.append(f"| {name_of(p, points, True)} | {' | '.join(cells)} |")
    return [*lines, "", *(f"{name}: {why}.  " for name, why in refused.items())]
