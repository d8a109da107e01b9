"""What is drawn and written from made-up results: labels apart, machines told, pages whole."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import pytest
from chart_tables import METHODS, A, B, cell, study

from hoigs.studies.chart_curves import curve_chart
from hoigs.studies.chart_data import points_of
from hoigs.studies.chart_draw import accuracy_chart
from hoigs.studies.chart_labels import Box, place, spread_out
from hoigs.studies.chart_style import PALETTE, _contrast, ink_of, is_log, short_number
from hoigs.studies.chart_write import by_clip, write_chart

FEW = {name: METHODS[name] for name in ("hoigs", "4dgs", "static-3dgs")}


def _texts(figure) -> str:
    from matplotlib.text import Text

    return "\n".join(t.get_text() for t in figure.findobj(Text))


def test_labels_keep_off_each_other_and_off_points() -> None:
    anchors = [(100.0 + 6 * i, 100.0 + 4 * (i % 3)) for i in range(8)]
    points = [Box(x - 4, y - 4, x + 4, y + 4) for x, y in anchors]
    bounds = Box(0, 0, 400, 300)
    placed = place(anchors, [(50.0, 12.0)] * 8, points, bounds)
    assert all(a.box.overlap(b.box) == 0 for a, b in combinations(placed, 2))
    assert all(p.box.overlap(point) == 0 for p in placed for point in points)
    assert all(p.box.outside(bounds) == 0 for p in placed)


def test_columns_of_labels_keep_order_and_distance() -> None:
    found = spread_out([10.0, 12.0, 11.0, 90.0], 10, 0, 100)
    assert sorted(found) == [found[0], found[2], found[1], found[3]]
    assert min(b - a for a, b in zip(sorted(found), sorted(found)[1:])) > 9.9
    assert spread_out([], 1, 0, 1) == [] and min(found) >= 0


def test_numbers_axes_and_inks() -> None:
    assert [short_number(v) for v in (2.5e6, 12000, 0.25)] == ["2.5M", "12k", "0.25"]
    assert is_log([1, 4]) and not is_log([1, 3.9]) and not is_log([0, 9]) and not is_log([])
    for color in PALETTE:
        ink = ink_of(color)
        assert _contrast([int(ink[i : i + 2], 16) / 255 for i in (1, 3, 5)]) >= 4.4


def test_nine_specs_are_labelled_without_overlap() -> None:
    drawn = accuracy_chart(points_of(study(seeds=2, lpips=False)), "carry")
    assert drawn is not None and len(drawn.labels) == 2 * 4, "two accuracies, four costs"
    for panel in drawn.labels:
        assert len(panel) == len(METHODS)
        shared = sum(a.overlap(b) for a, b in combinations(panel, 2))
        assert shared <= 0.02 * sum((b.x1 - b.x0) * (b.y1 - b.y0) for b in panel)
    text = _texts(drawn.figure)
    assert "LPIPS, full frame: not computed: no LPIPS weights" in text
    assert "training (J): not computed: this machine does not tell" in text
    assert f"Measured on {A}" in text and "2 seeds a point" in text


def test_two_machines_are_told_and_their_times_refused() -> None:
    points = points_of(study(FEW, machines=(A, B), seeds=1, lpips=False))
    apart = accuracy_chart(points, "carry")
    mixed = accuracy_chart(points, "carry", mix_machines=True)
    assert apart is not None and mixed is not None
    assert len(apart.labels) == 2 * 2 and len(mixed.labels) == 2 * 4
    for drawn in (apart, mixed):
        text = _texts(drawn.figure)
        assert "carry: points of 2 machines" in text and f"machine B: {B}" in text
    assert "not drawn: measured on 2 machines" in _texts(apart.figure)
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


def test_the_page_needs_nothing_else(written: Path) -> None:
    page = (written / "chart.html").read_text()
    assert not re.search(r"(src|href)=|https?://(?!www\.w3\.org)|@import|url\(", page)
    assert page.count("</script>") == 2 and "<!--" not in page
    assert "<1>" not in page and "it fell &lt;/script&gt;" in page


def test_the_table_says_who_dominates(written: Path) -> None:
    text = (written / "chart.md").read_text()
    assert f"Measured on {A}." in text and "2 frames of split 'test'" in text
    row = next(line for line in text.splitlines() if line.startswith("| 4dgs, 1000 steps |"))
    assert "hoigs, 200 steps" in row  # 24.9 dB in 28 s against 23.1 dB in 118 s
    assert "hoigs, carry, 1000 steps, seed 9: it fell" in text
    assert "| hoigs | 1000 | 2 |" in text


def test_sheets_are_of_clips_with_points() -> None:
    assert by_clip([cell(missing="it fell")]) == {}
    assert list(by_clip([cell(), cell(clip="b", missing="it fell")])) == ["carry"]
