"""Tables as Markdown for people, CSV for spreadsheets, and JSON with every seed."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

from hoigs.core.errors import did_you_mean
from hoigs.core.system.files import write_whole
from hoigs.evaluation.geometry import GEOMETRY
from hoigs.evaluation.protocol import NotComputed
from hoigs.evaluation.scores import DIGITS, TITLES
from hoigs.studies.jobs.results import (
    ALL_CLIPS,
    Measure,
    Row,
    RowResult,
    Spread,
    TableResult,
    mean_of_clips,
)

# The paper's numbers, from paper.yaml; they are shown as published on other data.

PAPER_METRICS = ("psnr", "lpips", "cd_best")


@dataclass(frozen=True)
class Published:
    """One row of one of the paper's tables.

    Attributes:
        source: its table. data: what it was measured on. scenes: how many.
        means: of the rows that the paper gives, by metric. printed: its own averages; where the
            two disagree, the paper contradicts itself.
    """

    source: str
    data: str
    row: str
    scenes: int
    means: dict[str, float]
    printed: dict[str, float]

    def value(self, metric: str) -> float | None:
        """The mean of the scenes where they are given, else what is printed."""
        return self.means.get(metric, self.printed.get(metric))


@cache
def _tables() -> dict[str, Any]:
    import yaml

    with Path(__file__).with_name("paper.yaml").open() as file:
        tables: dict[str, Any] = yaml.safe_load(file)
    return tables


def published(reference: str) -> Published:
    """The row "TABLE/ROW" of paper.yaml.

    Raises:
        KeyError: there is none.
    """
    table, _, row = reference.partition("/")
    known = [f"{name}/{r}" for name, content in _tables().items() for r in content["rows"]]
    if reference not in known:
        raise KeyError(f"{reference!r} is not in paper.yaml{did_you_mean(reference, known)}")
    content = _tables()[table]
    numbers = content["rows"][row]
    means = {m: mean(numbers[m]) for m in PAPER_METRICS if m in numbers}
    scenes = len(content.get("scenes", ()))
    return Published(
        content["source"], content["data"], row, scenes, means, numbers.get("printed", {})
    )


REGIONS = ("full", "human_object", "human", "object", "interaction")
METRICS = ("psnr", "ssim", "lpips")
VIEWS = ("test frames", "held-out cameras")
FINE = {"cd_best": 4, "gaussians": 0}  # digits of single measures
PAPER = {"psnr": "PSNR dB ↑", "lpips": "LPIPS ↓", "cd_best": "CD_best m² ↓", "fps": "frames/s ↑"}
TIMES = {"total_ms": "ms a frame", "gaussians": "Gaussians", "megabytes": "MB"}
ELSEWHERE = (
    "Published by the paper, **on other data** and by its own protocol; not to be compared number "
    "by number with the tables above."
)


def write_tables(results: Sequence[TableResult], out: Path, about: dict[str, Any]) -> list[Path]:
    """`tables.md`, `tables.csv` and `tables.json` in `out`, each whole or not at all.

    Args:
        about: how they were made (clips, seeds, steps, settings, protocol), JSON values.
    """
    out.mkdir(parents=True, exist_ok=True)
    texts = {
        "tables.md": markdown(results, about),
        "tables.csv": as_csv(results),
        "tables.json": json.dumps(as_dict(results, about), indent=1, allow_nan=False),
    }
    for name, text in texts.items():
        write_whole(out / name, text)
    return [out / name for name in texts]


def by_clip(result: TableResult) -> dict[str, Sequence[RowResult]]:
    """The rows of each clip, and of all together where there are several."""
    clips = dict(result.rows)
    if len(clips) > 1:
        columns = zip(*clips.values(), strict=True)
        clips[ALL_CLIPS] = [mean_of_clips(rows) for rows in columns]
    return clips


def markdown(results: Sequence[TableResult], about: dict[str, Any]) -> str:
    """One section a table set; what is not computed is a dash, with a note on the reason."""
    lines = ["# Tables", "", *(f"- {name}: {value}" for name, value in about.items()), ""]
    for result in results:
        lines += [f"## {result.table.title}", ""]
        for clip, rows in by_clip(result).items():
            lines += [f"### {clip}", ""]
            lines += _clip_tables(rows)
        lines += _paper_table([row for row in result.table.rows if row.paper])
    return "\n".join(lines).rstrip() + "\n"


def _clip_tables(rows: Sequence[RowResult]) -> list[str]:
    """Rows that are not computed stand in the first table only, with the reason."""
    lines, whole = [], [row for row in rows if not row.missing]
    for view in VIEWS:
        for metric in METRICS:
            keys = [(view, region, metric) for region in REGIONS]
            titles = [region.replace("_", " + ") for region in REGIONS]
            shown = rows if (view, metric) == (VIEWS[0], METRICS[0]) else whole
            lines += _grid(f"{TITLES[metric]}, {view}", titles, keys, shown, DIGITS[metric])
    names = [n for n in GEOMETRY if not n.endswith(("accuracy", "completeness"))]
    titles = [GEOMETRY[n] for n in names]
    lines += _grid("Geometry", titles, [("geometry", "", n) for n in names], whole, 2)
    keys = [("time" if name.endswith("ms") else "size", "", name) for name in TIMES]
    return lines + _grid("Time and size", list(TIMES.values()), keys, whole, 2)


def _grid(
    title: str,
    columns: Sequence[str],
    keys: Sequence[Measure],
    rows: Sequence[RowResult],
    digits: int,
) -> list[str]:
    """One Markdown table; a single line where no row has any of it."""
    table = [[row.over_seeds(key) for key in keys] for row in rows if not row.missing]
    absent = [v.reason for line in table for v in line if isinstance(v, NotComputed)]
    if len(absent) == len(table) * len(keys) and len(table) == len(rows):
        return [f"{title}: not computed: {'; '.join(dict.fromkeys(absent))}", ""] if rows else []
    notes: dict[str, int] = {}
    lines = [f"{title}:", "", f"| | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for row in rows:
        values = [row.over_seeds(key) for key in keys]
        if row.missing:
            lines.append(f"| {row.row.label} | {values[0]} |" + " |" * (len(columns) - 1))
            continue
        cells = []
        for key, value in zip(keys, values, strict=True):
            if isinstance(value, NotComputed):
                cells.append(f"– ({notes.setdefault(value.reason, len(notes) + 1)})")
            else:
                cells.append(_number(value, FINE.get(key[2], digits)))
        lines.append(f"| {row.row.label} | {' | '.join(cells)} |")
    lines.append("")
    lines += [f"({n}) not computed: {reason}  " for reason, n in notes.items()]
    return [*lines, ""] if notes else lines


def _number(value: Spread, digits: int) -> str:
    spread = "" if value.std is None else f" ± {value.std:.{digits}f}"
    return f"{value.mean:.{digits}f}{spread}"


def _paper_table(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    lines = [ELSEWHERE, "", f"| | where | {' | '.join(PAPER.values())} |", "|---" * 6 + "|"]
    for row in rows:
        for found in map(published, row.paper):
            cells = [_published(found, metric) for metric in PAPER]
            where = f"{found.source}, {found.data}"
            lines.append(f"| {row.label} | {where} | {' | '.join(cells)} |")
    return [*lines, ""]


def _published(found: Published, metric: str) -> str:
    """The mean of the printed scenes; with the printed average where that is another number."""
    value, printed = found.value(metric), found.printed.get(metric)
    if value is None:
        return ""
    digits = {"lpips": 3, "cd_best": 4}.get(metric, 2)
    text = f"{value:.{digits}f}"
    differs = printed is not None and abs(printed - value) > 0.6 * 10**-digits
    return f"{text} (printed: {printed:.{digits}f})" if differs else text


def flat(results: Sequence[TableResult]) -> Iterator[dict[str, Any]]:
    """Every number of every table as one record, the paper's among them and marked so."""
    for result in results:
        for clip, rows in by_clip(result).items():
            for row in rows:
                base = {"table": result.table.name, "row": row.row.label, "spec": row.row.spec,
                        "source": "this study", "data": clip}  # fmt: skip
                for key in _keys(row):
                    value = row.over_seeds(key)
                    names = dict(zip(("view", "region", "metric"), key, strict=True))
                    yield base | names | _numbers(value)
        for line in result.table.rows:
            for found in map(published, line.paper):
                for metric in dict.fromkeys((*found.means, *found.printed)):
                    yield {
                        "table": result.table.name, "row": line.label, "spec": line.spec,
                        "source": f"paper, {found.source}", "data": found.data,
                        "view": "as published", "region": "full", "metric": metric,
                        "mean": found.value(metric), "std": None, "n": None, "values": [],
                        "not_computed": None, "printed": found.printed.get(metric),
                    }  # fmt: skip


def _keys(row: RowResult) -> list[Measure]:
    found = dict.fromkeys(key for measures in row.by_seed.values() for key in measures)
    return list(found) or [("test frames", region, m) for region in REGIONS for m in METRICS]


def _numbers(value: Spread | NotComputed) -> dict[str, Any]:
    if isinstance(value, NotComputed):
        return {"mean": None, "std": None, "n": 0, "values": [], "not_computed": value.reason}
    return {"mean": value.mean, "std": value.std, "n": len(value.values),
            "values": list(value.values), "not_computed": None}  # fmt: skip


def as_csv(results: Sequence[TableResult]) -> str:
    columns = ("table", "row", "spec", "source", "data", "view", "region", "metric", "mean", "std",
               "n", "values", "not_computed")  # fmt: skip
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for record in flat(results):
        writer.writerow(record | {"values": " ".join(f"{v:.6g}" for v in record["values"])})
    return text.getvalue()


def as_dict(results: Sequence[TableResult], about: dict[str, Any]) -> dict[str, Any]:
    tables = []
    for result in results:
        runs = [
            {"row": row.row.label, "settings": list(row.row.settings), "clip": clip,
             "runs": {str(seed): run for seed, run in row.runs.items()},
             "missing": {str(seed): why for seed, why in row.missing.items()}}
            for clip, rows in result.rows.items()
            for row in rows
        ]  # fmt: skip
        tables.append({"name": result.table.name, "title": result.table.title, "runs": runs})
    return {
        "format": "hoigs-tables",
        "version": 1,
        "about": about,
        "tables": tables,
        "numbers": list(flat(results)),
    }
