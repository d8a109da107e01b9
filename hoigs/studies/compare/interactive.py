"""The interactive chart: one HTML page of plotly that contains plotly.js and opens offline."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from itertools import product
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.studies.compare.data import (
    ACCURACY,
    AXES,
    COST,
    Axis,
    Cell,
    Point,
    Series,
    front,
    machine_sentences,
    series_of,
    usable_axes,
)
from hoigs.studies.jobs.results import Spread
from hoigs.studies.plots import FAINT, FRONT, INK, is_log, short_number

SYMBOLS = {"o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down",
           "P": "cross", "X": "x", "h": "hexagon"}  # fmt: skip
# plotly 7 has a button that uploads the chart, unless it is switched off
CONFIG = {"showSendToCloud": False, "displaylogo": False, "responsive": True,
          "modeBarButtonsToRemove": ["select2d", "lasso2d"]}  # fmt: skip
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>hoigs: accuracy against cost</title>
<style>body {{ font: 14px/1.5 sans-serif; color: {ink}; margin: 1.5rem; }}</style></head><body>
<h1>Accuracy against cost</h1>
<p>Filled markers are on the Pareto front (dashed). Bars: one standard deviation over seeds. Larger:
more steps. Point at a marker for all its numbers; click a name to hide it; drag to zoom in.</p>
{sections}
<h2>How this was made</h2>
<ul>{facts}</ul>
</body></html>
"""


def require_plotly() -> None:
    """HoigsError if plotly is not installed; to be called before a study trains for hours."""
    if find_spec("plotly") is None:
        raise HoigsError("the interactive chart needs plotly: pip install 'hoigs[charts]'")


def page(
    cells: Sequence[Cell],
    sheets: Mapping[str, Sequence[Point]],
    about: Mapping[str, Any],
    mix_machines: bool,
) -> str:
    """The page as text, a section a clip. `sheets`: the points of each clip."""
    require_plotly()
    facts = [f"{k}: {v}" for k, v in about.items()]
    facts += [f"missing: {c.spec}, {c.clip}, {c.steps} steps, seed {c.seed}: {c.missing}"
              for c in cells if c.missing]  # fmt: skip
    sections = [] if sheets else ["<p>No run is done.</p>"]
    for number, (clip, points) in enumerate(sheets.items()):
        chart = _figure(points, mix_machines).to_html(
            full_html=False, include_plotlyjs=number == 0, div_id=f"chart-{number}",
            config=CONFIG,
        )  # fmt: skip
        absent = usable_axes(points, (*ACCURACY, *COST), mix_machines)[1]
        notes = [*machine_sentences(points), *(f"{name}: {why}." for name, why in absent.items())]
        words = [f"<p>{html.escape(note)}</p>" for note in notes]
        sections += [f"<h2>{html.escape(clip)}</h2>", *words, chart]
    items = "".join(f"<li>{html.escape(fact)}</li>" for fact in facts)
    return PAGE.format(ink=INK, sections="\n".join(sections), facts=items)


def _figure(points: Sequence[Point], mix_machines: bool) -> Any:
    """Accuracy against cost on the left, curves of training on the right, with menus above."""
    from plotly.subplots import make_subplots

    series = series_of(points)
    steps = sorted({p.steps for p in points})
    usable = usable_axes(points, (*ACCURACY, *COST), mix_machines)[0]
    figure = make_subplots(rows=1, cols=2, column_widths=[0.6, 0.4], horizontal_spacing=0.07)
    figure.add_scatter(mode="lines", name="Pareto front", hoverinfo="skip", row=1, col=1,
                       line={"color": FRONT, "dash": "dash", "shape": "hv"})  # fmt: skip
    for s in series:
        sizes = [11 + 6 * steps.index(p.steps) / len(steps) for p in s.points]
        figure.add_scatter(
            mode="lines+markers", name=s.name, legendgroup=s.name, line_color=s.color,
            line_width=1, marker_line={"width": 2, "color": s.color}, marker_size=sizes,
            marker_opacity=1,
            hovertext=[details(p) for p in s.points], hoverinfo="text", error_x_width=0,
            error_y_width=0, row=1, col=1,
        )  # fmt: skip
    curves = [s for s in series if len(s.points[-1].curve) > 1]
    for s in curves:
        figure.add_scatter(
            mode="lines+markers", name=s.name, legendgroup=s.name, showlegend=False,
            line_color=s.color, marker_symbol=SYMBOLS[s.marker],
            y=[c[2] for c in s.points[-1].curve], hovertext=details(s.points[-1]),
            hoverinfo="x+y+text", row=1, col=2,
        )  # fmt: skip
    pairs = [(x, y) for y, x in product(ACCURACY, COST) if x in usable and y in usable]
    axes = [(f"{y.title} against {x.title}", _axes_update(series, x, y)) for x, y in pairs]
    kinds = (("linear", "linear"), ("logarithmic", "log")) if pairs else ()
    scales = [(word, [{}, {"xaxis.type": kind, "xaxis.autorange": True}, [0]])
              for word, kind in kinds]  # fmt: skip
    over = [("seconds of training", 1)] * (AXES["train_s"] in usable) + [("steps", 0)]
    times = [
        (f"curves over {title}",
         [{"x": [[c[which] for c in s.points[-1].curve] for s in curves]},
          {"xaxis2.title.text": title, "xaxis2.autorange": True},
          list(range(1 + len(series), len(figure.data)))])
        for title, which in over if curves
    ]  # fmt: skip
    for menu in (axes[:1], times[:1]):  # the page opens with the first entry of each
        for _, update in menu:
            figure.plotly_update(*update)
    menus = [_menu(0, axes), _menu(0.38, scales, type="buttons", direction="right",
                                   showactive=False), _menu(0.64, times)]  # fmt: skip
    figure.update_layout(
        template="plotly_white", height=620, font_color=INK, margin={"t": 70, "l": 70, "r": 20},
        hoverlabel={"align": "left", "bgcolor": "white", "font": {"size": 12, "color": INK}},
        hovermode="closest", legend={"groupclick": "togglegroup"},
        updatemenus=[menu for menu in menus if menu["buttons"]],
    )  # fmt: skip
    figure.update_yaxes(title_text="PSNR, full frame (dB)", row=1, col=2)
    return figure


def _menu(x: float, entries: Sequence[tuple[str, list[Any]]], **more: Any) -> dict[str, Any]:
    """A menu above the figure. entries: label, and arguments of plotly's `update`."""
    buttons = [{"label": label, "method": "update", "args": args} for label, args in entries]
    return {"x": x, "y": 1.02, "xanchor": "left", "yanchor": "bottom", "bordercolor": FAINT,
            "buttons": buttons, **more}  # fmt: skip


def _axes_update(series: Sequence[Series], x: Axis, y: Axis) -> list[Any]:
    """Arguments of plotly's `update` that put the front and the series on the axes x and y."""
    points = [p for s in series for p in s.points]
    best = front(points, (x, y))
    traces = [best, *(s.points for s in series)]  # plotly leaves out what has no number
    filled = [[any(p is q for q in best) for p in own] for own in traces]
    symbols = ["circle", *(SYMBOLS[s.marker] for s in series)]
    return [
        {
            "x": [[p.number(x) for p in own] for own in traces],
            "y": [[p.number(y) for p in own] for own in traces],
            "error_x.array": [[], *([p.spread(x) for p in own] for own in traces[1:])],
            "error_y.array": [[], *([p.spread(y) for p in own] for own in traces[1:])],
            "marker.symbol": [
                [symbol if full else f"{symbol}-open" for full in own]
                for symbol, own in zip(symbols, filled, strict=True)
            ],
        },
        {
            "xaxis.title.text": x.title,
            "xaxis.type": "log" if is_log([v for p in points if (v := p.number(x))]) else "linear",
            "xaxis.autorange": True,
            "yaxis.title.text": y.title + (", reversed" if y.better == "lower" else ""),
            "yaxis.autorange": "reversed" if y.better == "lower" else True,
        },
        list(range(len(traces))),
    ]


def details(p: Point) -> str:
    """What is shown when a marker is pointed at; plotly breaks lines at <br> alone."""
    lines = [f"{p.definition} · rasterizer:{p.rasterizer} · {p.steps} steps",
             f"clip {p.clip} · {len(p.seeds)} seed{'s' if len(p.seeds) > 1 else ''} "
             f"({', '.join(map(str, p.seeds))})"]  # fmt: skip
    for name, axis in AXES.items():
        value = p.values.get(name)
        if isinstance(value, Spread):
            spread = "" if value.std is None else f" ± {short_number(value.std)}"
            lines.append(f"{axis.title}: {short_number(value.mean)}{spread}")
    lines += [f"missing: seed {seed}: {why}" for seed, why in p.missing.items()]
    lines += [p.machine, " ".join(p.protocol)]
    wrapped = [part for line in lines for part in textwrap.wrap(line, 90)]
    return "<br>".join([f"<b>{html.escape(p.spec)}</b>", *map(html.escape, wrapped)])
