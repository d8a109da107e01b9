"""Training curves as inline SVG, from a run's metrics.jsonl."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from hoigs.evaluation.protocol import NotComputed
from hoigs.evaluation.scores import ViewScores

INK, QUIET, LINES = "#e9e6df", "#8d9097", "#2b2f37"
HUES = ("#ffb26b", "#62c6b5", "#8fa8ff", "#f27d8b", "#c3d86a", "#c79bf2")
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text, in the page's own font
    "svg.hashsalt": "hoigs",  # the same run gives the same bytes
    "font.size": 10.5,
    "text.color": INK,
    "axes.labelcolor": QUIET,
    "axes.edgecolor": LINES,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINES,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
SHOWN_TERMS = 6


def loss_curve(records: Sequence[dict[str, Any]]) -> str:
    """Total loss and its largest terms, logarithmic."""
    steps = [r["step"] for r in records]
    last = records[-1].get("losses", {})
    names = [name for name in last if not name.startswith("regularizer/")]
    names.sort(key=lambda name: -abs(last[name]))

    def paint(axes: Axes) -> None:
        for name, hue in zip(names[:SHOWN_TERMS], HUES):
            points = [(r["step"], r["losses"][name]) for r in records if name in r["losses"]]
            positive = [(s, v) for s, v in points if v > 0]
            if positive:
                x, y = zip(*positive, strict=True)
                axes.plot(x, smoothed(y), color=hue, linewidth=1.1, label=name)
        total = [r["loss"] for r in records]
        axes.plot(steps, smoothed(total), color=INK, linewidth=1.8, label="total, weighted")
        axes.set_yscale("log")
        axes.legend(
            frameon=False, fontsize=9, labelcolor="linecolor", ncols=2, loc="upper center",
            bbox_to_anchor=(0.45, -0.2), columnspacing=1, handlelength=1.4,
        )  # fmt: skip

    return _figure("loss", "step", paint)


def psnr_curve(records: Sequence[dict[str, Any]]) -> str:
    """PSNR of a few frames of each split over training."""
    scored = [r for r in records if r.get("psnr")]
    splits = sorted({split for r in scored for split in r["psnr"]}, reverse=True)

    def paint(axes: Axes) -> None:
        for split, hue in zip(splits, HUES):
            points = [(r["step"], r["psnr"][split]) for r in scored if split in r["psnr"]]
            x, y = zip(*points, strict=True)
            axes.plot(x, y, color=hue, linewidth=1.8, marker="o", markersize=3, label=split)
        axes.legend(frameon=False, fontsize=9.5, labelcolor="linecolor", loc="lower right")

    return _figure("PSNR dB, a few frames", "step", paint)


def count_curve(records: Sequence[dict[str, Any]]) -> str:
    """Gaussians of each entity."""
    counted = [r for r in records if r.get("counts")]
    names = list(counted[-1]["counts"]) if counted else []

    def paint(axes: Axes) -> None:
        for name, hue in zip(names, HUES):
            points = [(r["step"], r["counts"][name]) for r in counted if name in r["counts"]]
            x, y = zip(*points, strict=True)
            axes.step(x, y, color=hue, linewidth=1.6, where="post", label=name)
        axes.set_ylim(bottom=0)
        axes.yaxis.set_major_formatter(FuncFormatter(_thousands))
        axes.legend(frameon=False, fontsize=9.5, labelcolor="linecolor")

    return _figure("Gaussians", "step", paint)


def frame_bars(view: ViewScores) -> str:
    """PSNR of each scored frame, of the full image and of human and object."""
    regions = {"full": "full frame", "human_object": "human + object"}

    def paint(axes: Axes) -> None:
        for offset, (region, label), hue in zip((-0.2, 0.2), regions.items(), HUES):
            bars = [
                (i, value)
                for i, frame in enumerate(view.frames)
                if not isinstance(value := frame.values[region]["psnr"], NotComputed)
            ]
            if bars:
                x, y = zip(*bars, strict=True)
                axes.bar([i + offset for i in x], y, 0.36, color=hue, label=label)
        axes.set_xticks(range(len(view.frames)), [str(f.index) for f in view.frames])
        axes.grid(False, axis="x")
        axes.legend(
            frameon=False, fontsize=9.5, labelcolor="linecolor", ncols=2, loc="upper center",
            bbox_to_anchor=(0.5, -0.16),
        )  # fmt: skip

    return _figure(f"PSNR dB of each frame, {view.name}", "frame", paint, width=5.6)


def smoothed(values: Sequence[float], keep: float = 0.8) -> list[float]:
    """Exponential moving average, corrected for its start as in Adam."""
    out, mean, weight = [], 0.0, 0.0
    for value in values:
        mean, weight = keep * mean + (1 - keep) * value, keep * weight + (1 - keep)
        out.append(mean / weight)
    return out


def _figure(title: str, xlabel: str, paint: Callable[[Axes], None], width: float = 4.2) -> str:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, 3.0), layout="constrained")
        axes = figure.add_subplot()
        paint(axes)
        axes.set_title(title, loc="left", fontsize=11.5)
        axes.set_xlabel(xlabel)
        axes.tick_params(length=0)
        if axes.get_xscale() == "linear" and xlabel == "step":
            axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        figure.patch.set_alpha(0)
        axes.patch.set_alpha(0)
        buffer = io.StringIO()
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    return svg[svg.index("<svg") :]  # without the XML head, which has no place inside HTML


def _thousands(value: float, _: int) -> str:
    return f"{value / 1000:g}k" if value >= 1000 else f"{value:g}"
