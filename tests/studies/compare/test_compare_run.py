"""A chart of two specs is killed, goes on, and is drawn."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.studies.compare.run import Comparison, plan
from hoigs.studies.jobs.results import parse_variants

CLIP = "builtin:carry?frames=8&width=32&samples=1&edge_samples=1&held_out_views=0&test_frames=2"
SPECS = "static,few=static+model.scene.points=60"
WORDS = ("study", "compare", CLIP, "--specs", SPECS, "--rasterizers", "warp", "--budgets", "6",
         "--seeds", "1", "--threads", "1", "--device", "cpu", "--set", "model.scene.points=200",
         "--set", "train.checkpoint_every=2")  # fmt: skip


pytestmark = pytest.mark.usefixtures("own_caches")


def _start(out: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "hoigs", *WORDS, "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def _alive(text: str) -> bool:
    """Whether a process that has this in its command line runs (Linux)."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if text in path.read_bytes().decode(errors="replace"):
                return True
        except OSError:  # it has just ended
            continue
    return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at processes through /proc")
def test_a_killed_chart_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "chart"
    first = _start(out)
    assert first.stdout is not None
    told = ""
    while not told.rstrip().endswith(": done"):  # then the second run is begun
        told += (line := first.stdout.readline())
        assert line, told
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    first.stdout.close()
    assert not (out / "chart.json").exists()
    deadline = time.monotonic() + 60
    while _alive(str(out)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not _alive(str(out)), "a run outlived its study"

    second = _start(out)
    told, _ = second.communicate()
    assert second.returncode == 0, told
    assert told.count("done before") >= 1 and told.count("wrote") >= 3 + 2

    data = json.loads((out / "chart.json").read_text())
    cells = data["cells"]
    assert [(c["spec"], c["seed"]) for c in cells] == [("static", 0), ("few", 0)]
    for cell in cells:
        own = json.loads((out / cell["run"] / "evaluation.json").read_text())
        (score,) = [s for s in own["scores"] if (s["view"], s["region"], s["metric"]) ==
                    ("test frames", "human_object", "psnr")]  # fmt: skip
        assert cell["values"]["psnr_human_object"] == score["value"]
        assert cell["values"]["train_s"] > 0 and cell["values"]["parameters"] > 0
        assert "HOIGS_LPIPS_WEIGHTS" in cell["values"]["lpips_full"]["not_computed"]
        assert "1 core;" in cell["machine"] and cell["protocol"][0].startswith("2 frames of split")
        assert [step for step, _, _ in cell["curve"]] == [1, 2, 3, 4, 5, 6]
    sizes = {c["spec"]: c["values"]["parameters"] for c in cells}
    assert sizes["few"] < sizes["static"]
    rows = list(csv.DictReader(io.StringIO((out / "chart.csv").read_text())))
    assert len(rows) > 2 * 10 and all(row["protocol"] for row in rows)
    figures = sorted(p.suffix for p in out.glob("chart-carry*"))
    assert figures == [".png", ".png", ".svg", ".svg"]


def test_the_plan_is_the_product_and_every_cell_a_job(tmp_path: Path) -> None:
    rows = {"": parse_variants(SPECS)}
    study = Comparison([CLIP], rows, tmp_path, ["warp", "torch"], [16, 4], 2)
    planned = plan(study)
    assert len({p.job.run for p in planned}) == len(planned) == 16
    assert {(p.cell.rasterizer, p.cell.steps) for p in planned} == {
        (r, s) for r in ("warp", "torch") for s in (16, 4)
    }
    assert "train.preview_every=2" in planned[0].job.settings
    assert not tmp_path.joinpath("runs").exists()


def test_what_does_not_exist_is_told_before_anything_runs(tmp_path: Path) -> None:
    for specs, rasterizers, told in (
        ("statik", [], '"static'),
        ("static+model.scene.pints=3", [], "pints"),
        ("static", ["wrap"], "rasterizer:warp"),
        ("static+train.seed=3", [], "--seeds"),
    ):
        with pytest.raises(HoigsError, match=told):
            plan(Comparison([CLIP], {"": parse_variants(specs)}, tmp_path, rasterizers))
