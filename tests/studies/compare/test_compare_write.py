"""Figures and tables of made-up results: legends apart, machines named."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pytest
from made_up_cells import METHODS, A, B, cell, study
from matplotlib.figure import Figure
from matplotlib.text import Text

from hoigs.studies.compare.data import machine_sentences, points_of, series_of
from hoigs.studies.compare.panels import accuracy_chart, curve_chart
from hoigs.studies.compare.write import by_clip, write_chart
from hoigs.studies.plots import is_log, short_number

FEW = {name: METHODS[name] for name in ("hoigs", "4dgs", "static-3dgs")}


def _texts(figure: Figure) -> str:
    return "\n".join(t.get_text() for t in figure.findobj(Text))


def test_numbers_and_axes() -> None:
    assert [short_number(v) for v in (2.5e6, 12000, 0.25)] == ["2.5M", "12k", "0.25"]
    assert is_log([1, 4]) and not is_log([1, 3.9]) and not is_log([0, 9]) and not is_log([])


def test_every_series_looks_different() -> None:
    many = {f"spec-{i}": METHODS["hoigs"] for i in range(20)}
    for cells in (study(many, seeds=1), study(machines=(A, B), rasterizers=("warp", "torch"))):
        series = series_of(points_of(cells))
        assert len({(s.color, s.marker) for s in series}) == len(series)
        assert len({s.name for s in series}) == len(series)
        assert all([p.steps for p in s.points] == [200, 1000] for s in series)


def test_title_legend_notes_and_panels_do_not_overlap() -> None:
    points = points_of(study(seeds=2, lpips=False))
    drawn, curves = accuracy_chart(points, "carry"), curve_chart(points, "carry")
    assert drawn is not None and len(drawn.axes) == 2 * 5, "two accuracies, five costs"
    assert curves is not None and len(curves.axes) == 2
    for figure in (drawn, curves):
        figure.canvas.draw()
        renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
        (legend,) = figure.legends
        assert {t.get_text() for t in legend.get_texts()} >= set(METHODS)
        boxes = [x.get_window_extent(renderer) for x in (legend, *figure.texts)]
        boxes += [axes.get_tightbbox(renderer) for axes in figure.axes]
        for a, b in combinations(boxes, 2):
            assert min(a.x1, b.x1) - max(a.x0, b.x0) < 2 or min(a.y1, b.y1) - max(a.y0, b.y0) < 2
        assert all(b.x1 <= figure.bbox.x1 + 1 for b in boxes)
    text = _texts(drawn)
    assert "no LPIPS weights" in text
    assert "this machine does not tell" in text
    assert A in text and "2 seeds" in text


def test_two_machines_are_named_and_their_times_refused() -> None:
    points = points_of(study(FEW, machines=(A, B), seeds=1, lpips=False))
    apart = accuracy_chart(points, "carry")
    mixed = accuracy_chart(points, "carry", mix_machines=True)
    assert apart is not None and mixed is not None
    assert len(apart.axes) == 2 * 2 and len(mixed.axes) == 2 * 5
    for figure in (apart, mixed):
        text = _texts(figure)
        assert "2 machines" in text and f"machine B: {max(A, B)}" in text
        # one letter a machine, however the points of a figure are ordered
        assert machine_sentences(points[::-1]) == machine_sentences(points)
    assert "not drawn: measured on 2 machines" in _texts(apart)
    assert len(curve_chart(points, "c").axes) == 1  # type: ignore[union-attr]
    assert len(curve_chart(points, "c", mix_machines=True).axes) == 2  # type: ignore[union-attr]


def test_nothing_to_draw_is_no_figure() -> None:
    (point,) = points_of([cell()])
    assert curve_chart([point], "c") is None
    (bare,) = points_of([cell(curve=())])
    assert accuracy_chart([bare], "c") is not None


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("chart")
    cells = study(FEW, clips=("carry", "throw?x=<1>"), seeds=2, lpips=False)
    cells.append(cell("hoigs", seed=9, steps=1000, missing="it fell </script>"))
    write_chart(cells, out, {"date": "a day"})
    return out


def test_every_clip_and_their_mean_have_figures(written: Path) -> None:
    stems = {p.stem for p in written.glob("*.svg")}
    assert stems == {"chart-carry", "chart-carry-curves", "chart-throw-x-1",
                     "chart-throw-x-1-curves", "chart-mean-of-all-clips"}  # fmt: skip
    assert stems == {p.stem for p in written.glob("*.png")} and not list(written.glob(".*"))
    svg = (written / "chart-carry.svg").read_text()
    assert ">hoigs</text>" in svg, "text stays text"


def test_the_table_says_who_dominates(written: Path) -> None:
    text = (written / "chart.md").read_text()
    assert A in text and "2 frames of split 'test'" in text
    row = next(line for line in text.splitlines() if line.startswith("| 4dgs, 1000 steps |"))
    assert "hoigs, 200 steps" in row  # 24.9 dB in 28 s against 23.1 dB in 118 s
    assert "hoigs, carry, 1000 steps, seed 9: it fell" in text
    assert "| hoigs | 1000 | 2 |" in text


def test_sheets_are_of_clips_with_points() -> None:
    assert by_clip([cell(missing="it fell")]) == {}
    assert list(by_clip([cell(), cell(clip="b", missing="it fell")])) == ["carry"]
