"""A study's files: stress.md, stress.csv, stress.json, and the figures of matrix and curves."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hoigs.core.files.whole_files import write_whole
from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.stress.capability import MEANING as HAS
from hoigs.studies.stress.case import Case
from hoigs.studies.stress.report.table import Table, in_short, rate_of, requirement_of
from hoigs.studies.stress.verdict import MEANING, Verdict

FORMAT, VERSION = "hoigs-stress", 1
MARKS = {"pass": "✓", "fail": "✗", "nature": "◐", "not applicable": "–", "not run": "?"}


def write_stress(table: Table, out: Path) -> list[Path]:
    """All files, each whole or not at all; curves only if a sweep has run."""
    from hoigs.studies.plotting.files import figure_files
    from hoigs.studies.stress.report.draw_curves import breakdown
    from hoigs.studies.stress.report.draw_matrix import matrix

    out.mkdir(parents=True, exist_ok=True)
    files: dict[str, bytes] = {
        "stress.json": as_json(table).encode(),
        "stress.csv": as_csv(table).encode(),
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
        "cases": [case.model_dump(mode="json") | {"kind": case.kind} for case in table.cases],
        "verdicts": [v.to_dict() for v in table.verdicts.values()],
    }
    return json.dumps(data, indent=1, allow_nan=False)


def as_csv(table: Table) -> str:
    """One number a line; a verdict without numbers is a line too."""
    columns = ("case", "title", "kind", "spec", "definition", "status", "rate", "breaks_at",
               "unit", "seed", "value", "stands", "measure", "number", "not_computed", "measured",
               "run", "machine", "protocol", *table.about)  # fmt: skip
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for case in table.cases:
        for spec in table.specs:
            verdict = table.at(case, spec)
            base = {
                "case": case.id, "title": case.title, "kind": case.kind, "spec": spec,
                "definition": table.definitions[spec], "status": verdict.status,
                "rate": "" if verdict.rate is None else f"{verdict.rate:.3f}",
                "breaks_at": "" if verdict.breaks_at is None else f"{verdict.breaks_at:g}",
                "unit": case.sweep.unit if case.sweep else "",
                "machine": " and ".join(verdict.machines),
                "protocol": " ".join(verdict.protocol), **table.about,
            }  # fmt: skip
            numbers = list(_numbers(verdict))
            for row in numbers or [{"measured": verdict.measured}]:
                writer.writerow(base | row)
    return text.getvalue()


def _numbers(verdict: Verdict) -> Iterator[dict[str, Any]]:
    for seed in verdict.seeds:
        for level in seed.levels:
            place = {"seed": seed.seed, "value": f"{level.value:g}", "stands": level.stands,
                     "measured": level.why, "run": level.run}  # fmt: skip
            if not level.values:
                yield place
            for name, value in level.values.items():
                absent = isinstance(value, NotComputed)
                yield place | {
                    "measure": name,
                    "number": "" if absent else repr(value),
                    "not_computed": value.reason if isinstance(value, NotComputed) else "",
                }


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
    if case.sweep is not None and verdict.seeds:
        words.append(in_short(case, verdict))
    return " ".join([*words, *([f"({rate})"] if rate else [])])


def _section(table: Table, case: Case) -> list[str]:
    lines = [f"### {case.id} {case.title}", "", f"Trigger: {case.trigger}. Passes: "
             f"{case.criterion}."]  # fmt: skip
    if case.concerns:
        lines[-1] += f" Concerns models with {', '.join(HAS[c] for c in case.concerns)}."
    if case.sweep is not None:
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
