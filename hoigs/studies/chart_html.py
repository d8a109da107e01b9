"""The interactive chart: one HTML file with its data, style and script inside; no other file."""

from __future__ import annotations

import html as escape
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from hoigs.studies.chart_data import ACCURACY, COST, Cell, Point
from hoigs.studies.chart_front import usable_axes
from hoigs.studies.chart_style import colors_of, ink_of, markers_of
from hoigs.studies.results import Spread


def html(
    cells: Sequence[Cell],
    sheets: Mapping[str, Sequence[Point]],
    about: Mapping[str, Any],
    mix_machines: bool,
) -> str:
    """The page as text."""
    everything = [p for points in sheets.values() for p in points]
    colors, markers = colors_of(everything), markers_of(everything)
    data = {
        "accuracy": [vars(a) for a in ACCURACY],
        "cost": [vars(a) for a in COST],
        "sheets": {
            clip: {
                "refused": usable_axes(points, (*ACCURACY, *COST), mix_machines)[1],
                "points": [
                    _point(p) | {
                        "color": colors[p.spec], "ink": ink_of(colors[p.spec]),
                        "marker": markers[p.rasterizer, p.machine],
                    }
                    for p in points
                ],
            }
            for clip, points in sheets.items()
        },
    }  # fmt: skip
    lost = [f"{c.spec}, {c.clip}, {c.steps} steps, seed {c.seed}: {c.missing}"
            for c in cells if c.missing]  # fmt: skip
    facts = [*(f"{k}: {v}" for k, v in about.items()), *(f"missing: {why}" for why in lost)]
    page = _asset("chart_page.html")
    for name, text in {
        "FACTS": "".join(f"<li>{escape.escape(fact)}</li>" for fact in facts),
        "STYLE": _asset("chart_style.css"),
        "SCRIPT": _asset("chart_script.js"),
        # "<" cannot end the script that holds it
        "DATA": json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
    }.items():
        page = page.replace(f"<!--{name}-->", text)
    return page


def _point(p: Point) -> dict[str, Any]:
    values = {
        name: {"mean": v.mean, "std": v.std, "n": len(v.values)}
        for name, v in p.values.items()
        if isinstance(v, Spread)
    }
    return {
        "spec": p.spec, "definition": p.definition, "rasterizer": p.rasterizer, "steps": p.steps,
        "clip": p.clip, "machine": p.machine, "seeds": list(p.seeds), "values": values,
        "protocol": list(p.protocol), "curve": [list(c) for c in p.curve],
        "missing": [f"seed {s}: {why}" for s, why in p.missing.items()],
    }  # fmt: skip


def _asset(name: str) -> str:
    return resources.files("hoigs.studies").joinpath(name).read_text(encoding="utf-8")
