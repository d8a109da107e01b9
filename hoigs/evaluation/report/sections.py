"""HTML of the report's sections; all texts from outside are escaped here."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.evaluation.report.media import Comparison, Cutout, Moving
from hoigs.evaluation.scores import Evaluation, Table, Timing
from hoigs.metrics.regions import MEANING


def tiles(evaluation: Evaluation, records: Sequence[dict[str, Any]]) -> str:
    """The headline numbers, without those that were not computed."""
    shown: list[tuple[str, str, str]] = []
    first = evaluation.views[0]
    for region, label in (("full", "full frame"), ("human_object", "human + object")):
        shown += _decibels(first.mean(region, "psnr")[0], label, first.name)
    for view in evaluation.views[1:]:
        shown += _decibels(view.mean("full", "psnr")[0], "full frame", view.name)
    count = sum(part.gaussians for part in evaluation.sizes)
    megabytes = sum(part.megabytes for part in evaluation.sizes)
    shown.append((short(count), "Gaussians", f"{megabytes:.1f} MB"))
    if isinstance(evaluation.timing, Timing):
        timing = evaluation.timing
        shown.append((f"{timing.fps:.3g}", "frames a second", f"on {timing.device}"))
    if records:
        seconds = records[-1]["time_s"]
        shown.append((clock(seconds), "training", f"{records[-1]['step']:,} steps"))
    cells = (
        f"<div class='tile'><b>{escape(number)}</b><span>{escape(what)}</span>"
        f"<small>{escape(detail)}</small></div>"
        for number, what, detail in shown
    )
    return f"<div class='tiles'>{''.join(cells)}</div>"


def made(method: str, parts: Sequence[str], command: str) -> str:
    """The method with its parts, and the command that made the run; empty strings are left out."""
    name = f"<b>{escape(method)}</b> " if method else ""
    line = f"<pre><code>{escape(command)}</code></pre>" if command else ""
    listed = f"<small>{escape(' · '.join(parts))}</small>"
    return f"<div class='made'><p>Method {name}{listed}</p>{line}</div>"


def _decibels(value: Value, what: str, view: str) -> list[tuple[str, str, str]]:
    if isinstance(value, NotComputed):
        return []
    return [(f"{value:.2f} dB", f"PSNR, {what}", view)]


def player(moving: Moving, captions: Sequence[str], *, playing: bool = False) -> str:
    """Pictures with a play button and a slider.

    Args:
        captions: HTML below the parts of each picture, from left to right.
        playing: from the start, except for readers whose system asks for less motion.
    """
    pictures = "".join(
        f"<img class='{'on' if i == 0 else ''}' src='{image}' alt='{escape(label, quote=True)}'>"
        for i, (label, image) in enumerate(zip(moving.labels, moving.pictures, strict=True))
    )
    words = "".join(f"<span>{caption}</span>" for caption in captions)
    return (
        f"<div class='player{' playing' if playing else ''}' "
        f"data-interval='{max(20, round(moving.interval_ms))}'>"
        f"<figure>{pictures}<figcaption>{words}</figcaption></figure>"
        "<p><button type='button'>Play</button>"
        f"<input type='range' min='0' max='{len(moving.pictures) - 1}' value='0' "
        f"aria-label='frame'><output>{escape(moving.labels[0])}</output></p></div>"
    )


def color_bar(what: str, colors: Sequence[str], low: str, high: str) -> str:
    """What false colours mean."""
    return (
        f"{escape(what)} <span class='colors'>{escape(low)} "
        f"<i style='background:linear-gradient(to right,{','.join(colors)})'></i> "
        f"{escape(high)}</span>"
    )


def files(paths: Sequence[str]) -> str:
    """Links to files beside the page."""
    links = (f"<a href='{quote(path)}'>{escape(path)}</a>" for path in paths)
    return f"<p class='files'>{' '.join(links)}</p>"


def commands(lines: Sequence[tuple[str, str]]) -> str:
    """Commands to copy, each with what it does."""
    rows = "".join(
        f"<dt><code>{escape(line)}</code></dt><dd>{escape(text)}</dd>" for line, text in lines
    )
    return f"<dl class='commands'>{rows}</dl>"


def comparer(comparisons: Sequence[Comparison], error: str) -> str:
    """Video and render under a slider, the error beside them, and thumbnails to choose a frame.

    Args:
        error: the colour bar of errors.
    """
    stages, thumbs = [], []
    for i, c in enumerate(comparisons):
        on = " on" if i == 0 else ""
        stages.append(
            f"<div class='stage{on}'><div class='slider'>"
            f"<img src='{c.render}' alt='render'>"
            f"<img class='top' src='{c.video}' alt='video'>"
            "<i class='line'></i><span class='tag left'>video</span>"
            "<span class='tag right'>reconstruction</span>"
            "<input type='range' min='0' max='100' value='50' step='0.1' "
            "aria-label='how much of the video to show'></div>"
            f"<div class='error'><img src='{c.error}' alt='error'>"
            "</div>"
            f"<p class='caption'><b>{escape(c.label)}</b> {escape(c.score)}</p>"
            f"<p class='caption'>{error}</p></div>"
        )
        thumbs.append(
            f"<button class='{on.strip()}' aria-label='{escape(c.label, quote=True)}'>"
            f"<img src='{c.thumb}' alt=''></button>"
        )
    return f"<div class='comparer'>{''.join(stages)}<nav>{''.join(thumbs)}</nav></div>"


def apart(cutouts: Sequence[Cutout]) -> str:
    """Each entity alone."""
    cells = (
        f"<figure class='{escape(c.kind, quote=True)}'><img src='{c.image}' "
        f"alt='{escape(c.name, quote=True)} alone'><figcaption><b>{escape(c.name)}</b> "
        f"{escape(c.kind) + ' · ' if c.kind != c.name else ''}{c.gaussians:,} Gaussians"
        "</figcaption></figure>"
        for c in cutouts
    )
    return f"<div class='apart'>{''.join(cells)}</div>"


def table(source: Table, *, words: bool = False) -> str:
    """A table with its notes; of `words`, lines are broken."""
    head = "".join(f"<th>{escape(c)}</th>" for c in source.columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in source.rows
    )
    notes = "".join(f"<li>{escape(note)}</li>" for note in source.notes)
    return (
        f"<div class='table{' words' if words else ''}'><h3>{escape(source.title)}</h3>"
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        f"<ul class='notes'>{notes}</ul></div>"
    )


def legend() -> str:
    """What the regions mean."""
    words = "; ".join(f"<b>{n.replace('_', ' + ')}</b> {escape(m)}" for n, m in MEANING.items())
    return f"<p class='legend'>{words}.</p>"


def time_bar(timing: Timing | NotComputed) -> str:
    """The shares of deformation and rasterization in the time of a frame."""
    if isinstance(timing, NotComputed):
        return ""
    share = 100 * timing.deform_ms / (timing.deform_ms + timing.raster_ms)
    return (
        "<div class='bar' role='img' aria-label='share of deformation and rasterization'>"
        f"<i class='deform' style='width:{share:.1f}%'></i><i class='raster'></i></div>"
        f"<p class='barkey'><span class='deform'>deformation {timing.deform_ms:.1f} ms</span>"
        f"<span class='raster'>rasterization {timing.raster_ms:.1f} ms</span></p>"
    )


def document(title: str, text: str) -> str:
    """The text of a file, collapsed."""
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def provenance(record: dict[str, Any], cleaned: Callable[[str], str]) -> str:
    """Versions as a list, and the whole record collapsed; `cleaned` takes private paths out."""
    versions = record.get("versions", {})
    items = "".join(
        f"<div><dt>{escape(str(k))}</dt><dd>{escape(str(v))}</dd></div>"
        for k, v in versions.items()
    )
    whole = document("provenance.json", cleaned(json.dumps(record, indent=1, ensure_ascii=False)))
    return f"<dl class='versions'>{items}</dl>{whole}"


def short(count: int) -> str:
    """12,345 as 12.3k."""
    if count >= 1_000_000:
        return f"{count / 1e6:.2f}M"
    return f"{count / 1000:.1f}k" if count >= 1000 else str(count)


def clock(seconds: float) -> str:
    """Seconds as 48 s, 5:07 or 2:05:00."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
