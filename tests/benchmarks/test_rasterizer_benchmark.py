"""The rasterizer benchmark on scenes of a few splats: what it writes, and that its peers agree."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _reach_benchmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))


def test_report_and_chart_are_written(tmp_path: Path) -> None:
    out = tmp_path / "report"
    command = [sys.executable, "-m", "benchmarks.rasterizers", "--scene", "synthetic"]
    command += ["--cases", "48x32/40", "64x32/80", "64x64/400", "--rounds", "3"]
    command += ["--peers", "warp", "torch", "gsplat", "--only", "times", "stages", "memory"]
    command += ["--date", "2026-01-31", "--out", str(out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["date"] == "2026-01-31"
    assert report["machine"]["processor"] and report["machine"]["versions"]["torch"]
    rows = {(row["case"], row["peer"]): row for row in report["times"]}
    assert "need CUDA" in rows["48x32/40", "gsplat"]["not_measured"]
    row = rows["48x32/40", "torch"]
    assert len(row["total_ms"]["samples"]) == 3
    low, high = row["total_ms"]["quartiles"]
    assert 0 < row["total_ms"]["least"] <= low <= row["total_ms"]["median"] <= high
    assert row["difference"] < 1e-6
    stages = report["stages"]["48x32/40"]
    assert stages["counts"]["intersections"] >= stages["counts"]["visible"] > 0
    assert all(0 < x["fraction"] < 1 for x in stages["of_limit"].values())
    assert report["memory"]["bytes_per_pixel"] > 20  # the images themselves
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert not out.with_suffix(".partial").exists()


def test_unknown_peers_are_named() -> None:
    command = [sys.executable, "-m", "benchmarks.rasterizers", "--scene", "synthetic"]
    done = subprocess.run(
        [*command, "--peers", "wrap"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "no peer 'wrap'" in done.stderr and "warp-captured" in done.stderr


def test_hits_are_those_of_compositing() -> None:
    from benchmarks.rasterizers.hits import count_hits, hits
    from benchmarks.rasterizers.scenes import synthetic
    from hoigs.rasterizers.oracle import OracleRasterizer
    from hoigs.rasterizers.warp import WarpRasterizer

    gaussians, camera = synthetic(60, 1)
    camera = camera.resized(50, 34)
    rows, pixels = hits(gaussians, camera, most=10**6)
    assert len(rows) == len(pixels) == count_hits(gaussians, camera)
    assert bool((pixels.diff() >= 0).all())
    # splats that hit no pixel do not matter, and one that does is seen
    drawn = torch.zeros(60, dtype=torch.bool)
    drawn[rows] = True
    whole = OracleRasterizer(OracleRasterizer.Config(cutoffs=True)).render(gaussians, camera).alpha
    part = WarpRasterizer().render(gaussians[drawn], camera).alpha.double()
    torch.testing.assert_close(part, whole, atol=1e-5, rtol=0)
    touched = torch.zeros(34 * 50, dtype=torch.bool)
    touched[pixels] = True
    assert torch.equal(touched.view(34, 50), whole > 0)


def test_stand_ins_for_nerfacc_composite_rays() -> None:
    from benchmarks.rasterizers.gsplat_torch import accumulate_along_rays, render_weight_from_alpha

    alphas = torch.tensor([0.4, 0.8, 0.1, 0.8, 0.1, 0.0, 0.9])
    rays = torch.tensor([0, 0, 0, 2, 2, 3, 3])  # nothing on ray 1
    weights, trans = render_weight_from_alpha(alphas, ray_indices=rays, n_rays=4)
    torch.testing.assert_close(trans, torch.tensor([1.0, 0.6, 0.12, 1.0, 0.2, 1.0, 1.0]))
    torch.testing.assert_close(weights, trans * alphas)
    values = torch.arange(7.0)[:, None]
    total = accumulate_along_rays(weights, values, ray_indices=rays, n_rays=4)
    torch.testing.assert_close(total[:, 0], torch.tensor([0.504, 0.0, 2.48, 5.4]))


def test_growth_is_the_factor_from_case_to_case() -> None:
    from benchmarks.rasterizers.timing import growth, spread

    rows = [
        {
            "case": f"8x8/{n}",
            "peer": peer,
            "total_ms": spread([time, time, 3 * time]),
            "cores_ms": spread([2 * time, time, time]),
        }
        for n, time in ((10, 2.0), (20, 3.0), (40, 6.0))
        for peer in ("warp", "torch")
    ]
    assert [x["factor"] for x in growth(rows, "warp")] == [1.5, 2.0]
    assert [x["factor_cores"] for x in growth(rows, "warp")] == [1.5, 2.0]
    assert growth(rows, "warp")[0]["to"] == "8x8/20"


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_memory_of_a_training_step_is_bounded(sh_degree: int) -> None:
    """The bound that docs/design/cpu-rasterizer.md states, with some room."""
    from benchmarks.rasterizers.memory import peak_bytes
    from benchmarks.rasterizers.scenes import synthetic
    from benchmarks.rasterizers.stages import count_intersections
    from hoigs.rasterizers.warp import WarpRasterizer

    for count, size in ((3000, (100, 70)), (500, (300, 200))):
        gaussians, camera = synthetic(count, sh_degree)
        camera = camera.resized(*size)
        rasterizer = WarpRasterizer(WarpRasterizer.Config(threads=1))
        _, intersections = count_intersections(gaussians, camera, rasterizer)
        fields = 4 * (11 + 3 * (sh_degree + 1) ** 2)
        bound = count * (100 + fields) + size[0] * size[1] * 42 + intersections * 50 + 40_000
        assert peak_bytes(gaussians, camera, rasterizer) < bound
