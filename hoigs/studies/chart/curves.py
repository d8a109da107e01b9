"""Quality during training: PSNR of test frames over seconds and over steps, one line a series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import matplotlib
from matplotlib.figure import Figure

from hoigs.studies.chart.data import Point
from hoigs.studies.chart.panels import framed, scale
from hoigs.studies.chart.series import machine_sentences, machines, series_of
from hoigs.studies.plotting.style import STYLE


def curve_chart(
    points: Sequence[Point], title: str, *, mix_machines: bool = False
) -> Figure | None:
    """The largest budget of every series; None where no run has previews.

    The panel over seconds is left out when several machines measured them, unless `mix_machines`.
    """
    series = series_of([p for p in points if len(p.curve) > 1])
    if not series:
        return None
    # the legend has the order of the lines' ends
    series = sorted((replace(s, points=s.points[-1:]) for s in series),
                    key=lambda s: -s.points[0].curve[-1][2])  # fmt: skip
    shown = [s.points[0] for s in series]
    timed = mix_machines or len(machines(shown)) == 1
    axes_of = [(1, "seconds of training"), (0, "steps")] if timed else [(0, "steps")]
    notes = ["PSNR of at most four test frames, full frame, during training; mean over seeds. The "
             "legend has the order of the last values.", *machine_sentences(shown)]  # fmt: skip
    if not timed:
        notes.append("Seconds are not drawn: several machines; --mix-machines draws them.")
    with matplotlib.rc_context(STYLE):
        figure = framed(title, points, notes, 5.2 * len(axes_of), 3.6)
        grid = figure.subplots(1, len(axes_of), squeeze=False, sharey=True)[0]
        for axes, (which, name) in zip(grid, axes_of, strict=True):
            for one in series:
                curve = one.points[0].curve
                axes.plot([c[which] for c in curve], [c[2] for c in curve], one.marker + "-",
                          color=one.color, linewidth=1.6, markersize=4, label=one.name)  # fmt: skip
            scale(axes, [s.points[0].curve[-1][which] for s in series])
            axes.set_xlabel(name)
            axes.tick_params(length=0)
        grid[0].set_ylabel("PSNR, full frame (dB)")
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside right upper")
    return figure
