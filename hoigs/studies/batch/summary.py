"""summary.html, summary.csv and summary.json of a batch."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from hoigs.core.system.files import written_whole
from hoigs.studies.batch.folder import BatchFolder, State, in_turn, stages_of
from hoigs.studies.batch.manifest import Row

METRICS = ("psnr", "ssim", "lpips")
VIEW, REGION = "test frames", "full"
THUMBNAIL = 160  # pixels high
PAGE_ROWS = 1000  # that summary.html shows, each with a picture in it
STYLE = (
    "body{font:15px system-ui,sans-serif;margin:2rem;color:#222}table{border-collapse:collapse}"
    "td,th{padding:.4rem .8rem;border-bottom:1px solid #ddd;text-align:left;vertical-align:middle}"
    "td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}img{height:80px;border-radius:4px}"
    ".failed{color:#b00020}.why{max-width:32rem;font-size:13px}"
)


def write_summary(folder: BatchFolder) -> list[Path]:
    """Write the three files, row by row; rows that are not done are in them with the reason."""
    names = ("summary.json", "summary.csv", "summary.html")
    paths = [folder.path / name for name in names]
    columns = ["name", "state", *METRICS, "seconds", "source", "spec", "why"]
    shown: list[str] = []
    count = done = 0
    with ExitStack() as stack:
        stack.enter_context(in_turn(folder.path / "summary"))
        parts = [stack.enter_context(written_whole(path)) for path in paths]
        as_json, as_csv = (
            stack.enter_context(part.open("w", encoding="utf-8", newline="")) for part in parts[:2]
        )
        table = csv.DictWriter(as_csv, columns, extrasaction="ignore")
        table.writeheader()
        for row in folder.rows():
            item = summary_of(row, folder)
            as_json.write(f"{',' if count else '['}\n{json.dumps(item, allow_nan=False)}")
            table.writerow({**item, **item["scores"]})
            if count < PAGE_ROWS:
                shown.append(_page_row(row, item, folder))
            count, done = count + 1, done + (item["state"] == "done")
        as_json.write("\n]\n" if count else "[]\n")
        parts[2].write_text(_page(shown, count, done), encoding="utf-8")
    return paths


def summary_of(row: Row, batch: BatchFolder) -> dict[str, Any]:
    """State, scores (numbers, or "not computed: why") and times of a row."""
    folder = batch.of(row)
    state = State.known(folder)
    stages = stages_of(row, folder)
    todo, stage = state.todo(stages), state.failed.stage
    times = {name: done.seconds for name, done in state.done.items()}
    why = state.failed.why
    return {
        "name": row.name,
        "state": "failed" if why else "done" if not todo else f"before {todo[0].name}",
        "why": why,
        "log": f"{batch.relative(row)}/{stage}.log" if stage in {s.name for s in stages} else "",
        "source": row.video or row.clip,
        "spec": row.spec,
        "scores": _scores(folder / "run" / "evaluation.json"),
        "seconds": round(sum(times.values()), 1),
        "seconds_of_stages": times,
        "attempts": state.attempts,
    }


def _scores(path: Path) -> dict[str, float | str]:
    if not path.is_file():
        return dict.fromkeys(METRICS, "not computed: the row is not evaluated")
    scores = json.loads(path.read_text()).get("scores", [])
    found = {s["metric"]: s["value"] for s in scores if (s["view"], s["region"]) == (VIEW, REGION)}
    return {m: _value(found.get(m)) for m in METRICS}


def _value(value: Any) -> float | str:
    if isinstance(value, int | float):
        return float(value)
    reason = value.get("not_computed", value) if isinstance(value, dict) else value
    return f"not computed: {reason or 'the evaluation has no such score'}"


def _page_row(row: Row, item: dict[str, Any], batch: BatchFolder) -> str:
    name, page = html.escape(row.name), "run/report.html"
    link = f'<a href="{batch.relative(row)}/{page}">{name}</a>'
    log = f' <a href="{html.escape(item["log"])}">log</a>' if item["log"] else ""
    return (
        f"<tr><td>{_thumbnail(row, batch.of(row))}</td>"
        f"<td>{link if (batch.of(row) / page).is_file() else name}</td>"
        f'<td class="{item["state"]}">{html.escape(item["state"])}{log}</td>'
        + "".join(_score_cell(item["scores"][m]) for m in METRICS)
        + f'<td class="n">{item["seconds"]:.1f}</td>'
        f'<td class="why">{html.escape(item["why"])}</td></tr>'
    )


def _page(body: Sequence[str], count: int, done: int) -> str:
    heads = "".join(f'<th class="n">{m.upper()}</th>' for m in METRICS)
    rest = f" The first {len(body)} rows; all are in summary.csv." if count > len(body) else ""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Batch</title>'
        f"<style>{STYLE}</style><h1>{done} of {count} rows done</h1>"
        f"<p>Scores of the {VIEW}, whole images.{rest}</p><table><tr><th></th><th>row</th>"
        f'<th>state</th>{heads}<th class="n">seconds</th><th></th></tr>{"".join(body)}</table>'
        "</html>\n"
    )


def _score_cell(value: float | str) -> str:
    if isinstance(value, str):
        return f'<td class="n" title="{html.escape(value)}">–</td>'
    return f'<td class="n">{value:.3f}</td>'


def _thumbnail(row: Row, folder: Path) -> str:
    """The middle frame of the row's clip as an image in the page; empty before it is prepared."""
    clip = folder / "clip" if row.video else Path(row.clip)  # a built-in one is in a cache
    images = sorted((clip / "images").glob("*"))
    if not images:
        return ""
    from PIL import Image

    try:
        with Image.open(images[len(images) // 2]) as image:
            small = image.convert("RGB")
    except OSError:
        return ""
    small.thumbnail((4 * THUMBNAIL, THUMBNAIL))
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=85)
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="a frame of {html.escape(row.name)}" src="data:image/jpeg;base64,{data}">'
