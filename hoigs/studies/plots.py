"""Style of figures: palette, order of markers, matplotlib settings, number formats."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from typing import Any, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

INK, QUIET, FAINT, FRONT = "#1d2126", "#5b626b", "#e4e6e9", "#8a9099"
DPI = 160
# Okabe and Ito (2008) without yellow, which is faint on white; dark ones of Tol's "muted"; black
PALETTE = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#332288", "#882255",
    "#44aa99", "#999933", "#661100", "#6c757d", "#000000",
)  # fmt: skip
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "h")


def color_of(index: int) -> str:
    return PALETTE[index % len(PALETTE)]


def marker_of(index: int) -> str:
    return MARKERS[index % len(MARKERS)]


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
    "legend.frameon": False,
}


def short_number(value: float) -> str:
    """2500000 is "2.5M", 12000 "12k", 0.25 "0.25"."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def is_log(values: Sequence[float]) -> bool:
    """Whether an axis is better logarithmic: positive, and spread over a factor of 4 or more."""
    return bool(values) and min(values) > 0 and max(values) >= 4 * min(values)


def framed(title: str, notes: Sequence[str], width: float, height: float) -> Figure:
    """A figure with a title above and notes below `width` x `height` inches of panels."""
    lines = [line for note in notes for line in textwrap.wrap(note, int(width * 15))]
    size = (width, height + 0.9 + 0.16 * len(lines))
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.01, ha="left", size=14, weight="bold")
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", size=8.5, color=QUIET)
    return figure


def scale(axes: Axes, which: Literal["x", "y"], values: Sequence[float]) -> None:
    """One axis of a panel: logarithmic where that is easier to read, with short numbers."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    if is_log(values):
        axes.set(**{f"{which}scale": "log"})
        decades = max(values) / min(values)
        subs = (1, 2, 5) if decades < 60 else (1, 3) if decades < 600 else (1,)
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_major_locator(MaxNLocator(5))
    axis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))


# nothing that differs between two runs of the same study
METADATA = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}


def figure_files(name: str, figure: Figure) -> dict[str, bytes]:
    """NAME.png and NAME.svg of a figure."""
    files = {}
    with matplotlib.rc_context(STYLE):
        for kind, metadata in METADATA.items():
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, metadata=metadata)
            files[f"{name}.{kind}"] = buffer.getvalue()
    return files
