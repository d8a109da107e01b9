"""Numbers of an evaluation, and those of the paper."""

from __future__ import annotations

import pytest

from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.compare.paper import TABLES, choose_tables, published
from hoigs.studies.jobs.results import measures_of

PSNR, LPIPS = ("test frames", "full", "psnr"), ("test frames", "full", "lpips")


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
    with pytest.raises(KeyError, match="hosnerf/hoigs"):
        published("hosnerf/hoig")


def test_every_row_of_every_table_has_a_source_and_a_spec_or_a_reason() -> None:
    assert choose_tables(["all"]) == TABLES and list(choose_tables(["object-prior"])) == [
        "object-prior"
    ]
    for table, rows in TABLES.items():
        labels = [row.label for row in rows]
        assert len(set(labels)) == len(labels), table
        for row in rows:
            assert (row.spec is None) == bool(row.why), (table, row.label)
            assert all(published(reference).printed or published(reference).means
                       for reference in row.paper)  # fmt: skip
