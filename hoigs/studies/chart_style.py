"""How charts look, on paper and on screen: palette, order of markers, writing of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hoigs.studies.chart_data import Point

INK, QUIET, FAINT = "#1d2126", "#5b626b", "#e4e6e9"
# Okabe and Ito (2008) without yellow, which is faint on white, then dark ones of Tol's "muted"
PALETTE = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#332288", "#882255",
    "#44aa99", "#999933", "#661100", "#6c757d",
)  # fmt: skip
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "h")

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "hoigs",  # the same table gives the same bytes
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#9aa0a8",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": FAINT,
    "grid.linewidth": 0.7,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "savefig.facecolor": "white",
}


def colors_of(points: Sequence[Point]) -> dict[str, str]:
    """One colour a spec, in order of appearance; with more specs than colours they repeat."""
    specs = dict.fromkeys(p.spec for p in points)
    return {spec: PALETTE[i % len(PALETTE)] for i, spec in enumerate(specs)}


def markers_of(points: Sequence[Point]) -> dict[tuple[str, str], str]:
    """One marker for each rasterizer on each machine."""
    pairs = dict.fromkeys((p.rasterizer, p.machine) for p in points)
    return {pair: MARKERS[i % len(MARKERS)] for i, pair in enumerate(pairs)}


def ink_of(color: str) -> str:
    """A colour for text, dark enough to be read on white (WCAG AA, 4.5 : 1)."""
    parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    while _contrast(parts) < 4.5:
        parts = [0.94 * p for p in parts]
    return "#" + "".join(f"{round(255 * p):02x}" for p in parts)


def _contrast(parts: Sequence[float]) -> float:
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    luminance = sum(w * p for w, p in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    return 1.05 / (luminance + 0.05)


def short_number(value: float) -> str:
    """2500000 is "2.5M", 12000 "12k", 0.25 "0.25"."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def is_log(values: Sequence[float]) -> bool:
    """Whether an axis is better logarithmic: positive, and spread over a factor of 4 or more."""
    return bool(values) and min(values) > 0 and max(values) >= 4 * min(values)


def names_of(points: Sequence[Point]) -> dict[int, str]:
    """The label of a point, by its place: its spec, and what tells it from others of that spec."""
    rasterizers = {p.rasterizer for p in points}
    machines = list(dict.fromkeys(p.machine for p in points))
    found = {}
    for i, point in enumerate(points):
        name = point.spec
        if len(rasterizers) > 1:
            name += f" · {point.rasterizer}"
        if len(machines) > 1:
            name += f" · machine {letter(machines.index(point.machine))}"
        found[i] = name
    return found


def letter(index: int) -> str:
    """Machine A, B … Z, then A1, B1 …"""
    return chr(ord("A") + index % 26) + (str(index // 26) if index >= 26 else "")
