"""Mean and spread over seeds and clips against numbers worked out by hand; the paper's numbers."""

from __future__ import annotations

import pytest

from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.jobs.results import ALL_CLIPS, Row, RowResult, Spread, mean_of_clips, measures_of
from hoigs.studies.tables.run import TABLE_SETS, choose_sets
from hoigs.studies.tables.write import published

ROW = Row("a", "hoigs")
PSNR, LPIPS = ("test frames", "full", "psnr"), ("test frames", "full", "lpips")


def _row(clip: str, values: list[float], missing: dict[int, str] | None = None) -> RowResult:
    by_seed = {
        seed: {PSNR: value, LPIPS: NotComputed("no weights")} for seed, value in enumerate(values)
    }
    return RowResult(ROW, clip, by_seed, missing or {})


def test_spread_is_the_sample_standard_deviation() -> None:
    found = _row("x", [20.0, 22.0, 27.0]).over_seeds(PSNR)
    assert found == Spread(23.0, pytest.approx(13**0.5), (20.0, 22.0, 27.0))
    assert _row("x", [20.0]).over_seeds(PSNR) == Spread(20.0, None, (20.0,))
    assert _row("x", [1.0, 2.0]).over_seeds(LPIPS) == NotComputed("no weights")


def test_a_row_that_lacks_a_seed_has_no_mean() -> None:
    assert _row("x", [1.0], {1: "it fell"}).over_seeds(PSNR) == NotComputed("seed 1: it fell")
    assert _row("x", [], {0: "it fell", 1: "it fell"}).over_seeds(PSNR).reason == "it fell"


def test_seeds_are_averaged_over_clips_before_their_spread_is_taken() -> None:
    both = mean_of_clips([_row("x", [20.0, 22.0]), _row("y", [30.0, 26.0])])
    assert both.clip == ALL_CLIPS
    assert both.over_seeds(PSNR) == Spread(24.5, pytest.approx(0.5**0.5), (25.0, 24.0))
    assert both.over_seeds(LPIPS) == NotComputed("x: no weights")
    broken = mean_of_clips([_row("x", [20.0, 22.0]), _row("y", [30.0], {1: "it fell"})])
    assert broken.over_seeds(PSNR) == NotComputed("seed 1: y: it fell")


def test_every_number_of_an_evaluation_is_found() -> None:
    score = {"view": "test frames", "region": "full", "metric": "psnr", "value": 20.5}
    lost = score | {"metric": "lpips", "value": {"not_computed": "no weights"}}
    part = {"gaussians": 10, "parameters": 100, "megabytes": 0.5}
    found = measures_of(
        {
            "scores": [score, lost],
            "geometry": {"cd_best": 0.25},
            "timing": {"not_computed": "skipped"},
            "size": [part, part],
        }
    )
    assert found[PSNR] == 20.5 and found[LPIPS] == NotComputed("no weights")
    assert found["geometry", "", "cd_best"] == 0.25
    assert found["time", "", "total_ms"] == NotComputed("skipped")
    assert found["size", "", "gaussians"] == 20


def test_the_papers_rows_average_as_recomputed() -> None:
    assert published("hosnerf/hoigs").value("psnr") == pytest.approx(25.893, abs=1e-3)
    assert published("hosnerf/exavatar").value("psnr") == pytest.approx(24.348, abs=1e-3)
    assert published("hosnerf/ex4dgs").value("psnr") == pytest.approx(17.968, abs=1e-3)
    behave = published("behave/e-d3dgs")
    assert behave.value("psnr") == pytest.approx(23.24, abs=0.01)
    assert behave.printed["psnr"] == 22.99 and behave.scenes == 8
    assert published("object-prior/depth").value("psnr") == pytest.approx(24.61, abs=0.01)
    assert published("interaction/no-interaction").value("psnr") == 25.24
    assert published("arctic-geometry/hold").source == "supplement, Table A"
    with pytest.raises(KeyError, match="did you mean"):
        published("hosnerf/hoig")


def test_every_row_of_every_set_has_a_source_and_a_spec_or_a_reason() -> None:
    for table in choose_sets([], []):
        labels = [row.label for row in table.rows]
        assert len(set(labels)) == len(labels), table.name
        for row in table.rows:
            assert (row.spec is None) == bool(row.why), (table.name, row.label)
            assert all(published(reference).printed or published(reference).means
                       for reference in row.paper)  # fmt: skip
    assert set(TABLE_SETS) == {
        "comparison", "ablation-object-motion", "ablation-interaction", "ablation-human-feature",
        "object-prior", "mask-depth-source",
    }  # fmt: skip
    (chosen,) = choose_sets([], ["4dgs@matched", "mine.yaml"])
    assert chosen.rows[0].paper[0] == "runtime/4dgs" and chosen.rows[1].paper == ()
