"""docs/results/tables.md of a chart.json that `hoigs study compare --table …` wrote, without times.

    python benchmarks/tables.py runs/tables/chart.json --out docs/results/tables.md \\
        --raw benchmarks/results/tables.json

Every cell is the mean over seeds ± their sample standard deviation. What is known of how the
chart was made heads the file, and is taken from `about` of the chart. --raw gets the numbers of
each seed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.compare.data import Axis, Cell, Point, all_clips, load_chart, points_of
from hoigs.studies.compare.paper import columns, published_table
from hoigs.studies.jobs.results import ALL_CLIPS, Spread

TITLES = {
    "comparison": "Comparison with other methods, matched settings",
    "ablation-object-motion": "Ablation: how the object moves",
    "ablation-interaction": "Ablation: the interaction module",
    "ablation-human-feature": "Ablation: the human's features",
    "object-prior": "Where the object's first Gaussians come from",
    "mask-depth-source": "Where masks and depth come from",
    "": "Specs by their own settings",
}
SIZE = ("Size", [Axis("size//gaussians", "Gaussians", "lower", 0),
                 Axis("parameters", "parameters", "lower", 0),
                 Axis("megabytes", "MB", "lower")])  # fmt: skip


def shown(point: Point, axis: Axis, notes: dict[str, int]) -> str:
    value = point.values.get(axis.name, NotComputed("this evaluation has no such score"))
    if not isinstance(value, Spread):
        return f"– ({notes.setdefault(value.reason, len(notes) + 1)})"
    spread = "" if not value.std else f" ± {value.std:,.{axis.digits}f}"
    return f"{value.mean:,.{axis.digits}f}{spread}"


def seeds_of(points: Sequence[Point], cells: Sequence[Cell]) -> str:
    """What is not of all seeds, in words; nothing where all is."""
    asked = {c.seed for c in cells}
    less = [f"{p.spec}: {', '.join(map(str, p.seeds))}" for p in points if set(p.seeds) != asked]
    return f"Seeds, where not all: {'; '.join(less)}." if less else ""


def sheet(cells: Sequence[Cell]) -> Iterator[str]:
    """The tables of one clip, or of the mean of all."""
    points, first = points_of(cells), True
    known = {p.spec for p in points}
    lost = {c.spec: c.missing for c in cells if c.missing and c.spec not in known}
    if said := seeds_of(points, cells):
        yield from (said, "")
    for title, axes in (*columns(points), SIZE):
        yield from (f"{title}:", "", f"| | {' | '.join(a.title for a in axes)} |")
        yield "|---" * (len(axes) + 1) + "|"
        notes: dict[str, int] = {}
        for point in points:
            yield f"| {point.spec} | {' | '.join(shown(point, a, notes) for a in axes)} |"
        if first:
            yield from (f"| {spec} | not computed: {why}{' |' * len(axes)}"
                        for spec, why in lost.items())  # fmt: skip
        yield ""
        if notes:
            yield from (f"({n}) not computed: {why}  " for why, n in notes.items())
            yield ""
        first = False
    if not any(name.startswith("held-out") for p in points for name in p.values):
        yield from ("Held-out cameras: not computed, the clip has none.", "")


def mean_of(cells: Sequence[Cell]) -> list[Cell]:
    """Cells of the mean of all clips; what some clip lacks has that clip's reason."""
    found = all_clips(cells)
    names = {c.spec for c in found}
    order = list(dict.fromkeys(c.spec for c in cells))
    lost = [c for c in cells if c.missing and c.spec not in names]
    lost.sort(key=lambda c: order.index(c.spec))
    whys = {c.spec: f"{c.clip}: {c.missing}" for c in lost if c.spec not in nowhere(cells)}
    return [
        *found,
        *(replace(c, clip=ALL_CLIPS, missing=whys.get(c.spec, c.missing)) for c in lost),
    ]


def nowhere(cells: Sequence[Cell]) -> set[str]:
    """Specs that were run on no clip."""
    return {c.spec for c in cells} - {c.spec for c in cells if not c.missing}


def either(sentences: Iterable[str]) -> str:
    """Sentences of "key: value; key: value" as one, with "/" between what differs."""
    found: dict[str, dict[str, None]] = {}
    for sentence in sentences:
        for clause in sentence.removesuffix(".").split("; "):
            key, colon, value = clause.partition(": ")
            found.setdefault(key + colon, {})[value] = None
    return "; ".join(f"{key}{_either(list(values))}" for key, values in found.items()) + "."


def _either(values: Sequence[str]) -> str:
    words = [value.split() for value in values]
    start = _equal(zip(*words, strict=False))
    rest = [own[start:] for own in words]
    end = _equal(zip(*(own[::-1] for own in rest), strict=False))
    differing = " / ".join(" ".join(own[: len(own) - end]) for own in rest)
    return " ".join(w for w in (*words[0][:start], differing, *rest[0][len(rest[0]) - end :]) if w)


def _equal(places: Iterable[tuple[str, ...]]) -> int:
    return sum(1 for _ in takewhile(lambda place: len(set(place)) == 1, places))


def raw(cells: Sequence[Cell]) -> str:
    """Every training once, a line each: clip, spec, seed, and the numbers of the columns."""
    axes = [a.name for _, own in (*columns(points_of(cells)), SIZE) for a in own]
    lines = {}
    for c in cells:
        if not c.missing:
            values = [c.values.get(name) for name in axes]
            numbers = [float(f"{v:.5g}") if isinstance(v, float) else None for v in values]
            lines[c.clip, c.definition, c.seed] = json.dumps(numbers)[1:-1]
    rows = ",\n".join(f"{json.dumps(key)[:-1]}, {numbers}]" for key, numbers in lines.items())
    return f'{{"columns": {json.dumps(["clip", "spec", "seed", *axes])},\n"rows": [\n{rows}\n]}}\n'


def document(cells: Sequence[Cell], about: dict[str, str]) -> Iterator[str]:
    yield from ("# Tables", "")
    yield from (f"- {key}: {value}" for key, value in about.items())
    for clip in dict.fromkeys(c.clip for c in cells):
        own = [c for c in cells if c.clip == clip and c.protocol]
        poses = either(dict.fromkeys(c.protocol[0] for c in own))
        yield f"- protocol of {clip}: {poses} {' '.join(own[0].protocol[1:3])}"
    for table in dict.fromkeys(c.table for c in cells):
        rows = [c for c in cells if c.table == table]
        yield from ("", f"## {TITLES.get(table, table)}", "")
        for clip in dict.fromkeys(c.clip for c in rows):
            yield from (f"### {clip}", "", *sheet([c for c in rows if c.clip == clip]))
        yield from (f"### {ALL_CLIPS}", "", *sheet(mean_of(rows)))
        if table:
            yield from published_table(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("chart", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--raw", type=Path)
    options = parser.parse_args()
    cells, about = load_chart(options.chart)
    lines = "\n".join(document(cells, about)).replace("\n\n\n", "\n\n")
    options.out.write_text(lines.rstrip() + "\n")
    if options.raw:
        options.raw.write_text(raw(cells))


if __name__ == "__main__":
    main()
