"""Texts of a chart, moved to where nothing else stands; a line leads to those that went far."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.text import Text

from hoigs.studies.chart_labels import Box, place

Spot = tuple[float, float]


def settle(
    axes: Axes,
    texts: Sequence[Text],
    spots: Sequence[Spot],
    obstacles: Sequence[Box],
    segments: Sequence[tuple[Spot, Spot]] = (),
    *,
    leaders: Sequence[str],
) -> list[Box]:
    """Move texts of `axes` beside their points, within its window; where each is now, pixels.

    To be called when the layout is done.

    Args:
        spots: the points that are named, pixels. obstacles, segments: as of `chart_labels.place`.
        leaders: colour of each text's line to its point.
    """
    renderer = axes.figure.canvas.get_renderer()  # type: ignore[attr-defined]
    sizes = [(e.width + 2, e.height + 2) for e in (t.get_window_extent(renderer) for t in texts)]
    window = axes.get_window_extent(renderer)
    bounds = Box(window.x0 + 2, window.y0 + 2, window.x1 - 2, window.y1 - 2)
    placed = place(spots, sizes, obstacles, bounds, segments)
    invert = axes.transData.inverted()
    for text, found, (x, y), color in zip(texts, placed, spots, leaders, strict=True):
        box = found.box
        text.set_position(tuple(invert.transform((box.x0 + 1, box.y0 + 1))))
        text.set_verticalalignment("bottom")
        if found.leader:
            near = (min(max(x, box.x0), box.x1), min(max(y, box.y0), box.y1))
            ends = invert.transform([(x, y), near])
            axes.plot(ends[:, 0], ends[:, 1], color=color, linewidth=0.7, alpha=0.8, zorder=2,
                      scalex=False, scaley=False)  # fmt: skip
    return [found.box for found in placed]
