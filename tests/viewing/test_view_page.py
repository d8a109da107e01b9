"""--html: what is stored comes back, sizes are kept, and the page draws what the library draws."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hoigs
from hoigs.core.errors import HoigsError
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.player.page import write_page
from hoigs.viewing.viewer.run_drawing import Look, RunDrawing

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def loaded(tiny_run: Path) -> LoadedRun:
    return LoadedRun.open(tiny_run, device="cpu")


def test_max_mb_is_kept_and_says_what_is_missing(loaded: LoadedRun, tmp_path: Path) -> None:
    whole = write_page(loaded, tmp_path / "whole.html")
    assert whole.gaussians == whole.of
    goal = whole.megabytes * 0.3
    small = write_page(loaded, tmp_path / "small.html", max_mb=goal)
    assert 0.5 * goal < small.megabytes <= goal and small.gaussians < small.of
    sentence = f"{small.gaussians:,} of {small.of:,} Gaussians"
    assert sentence in str(small) and sentence in small.path.read_text()
    with pytest.raises(HoigsError, match="still has"):
        write_page(loaded, tmp_path / "none.html", max_mb=0.02)
    with pytest.raises(HoigsError, match=r'did you mean "human"'):
        write_page(loaded, tmp_path / "none.html", entities=["humam"])
    with pytest.raises(HoigsError, match=r"ends in \.html"):
        write_page(loaded, tmp_path / "none.mp4")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["small.html", "whole.html"]


def test_the_file_names_no_other_address(tiny_run: Path, tmp_path: Path) -> None:
    page = hoigs.view(tiny_run, html=tmp_path / "a.html", entities=["object"], device="cpu")
    assert page is not None and "Without scene, human." in str(page)
    text = page.path.read_text()
    shell = re.sub(r'<script id="data".*?</script>', "", text, flags=re.DOTALL)
    assert "://" not in shell and "src=" not in shell and "default-src 'none'" in shell


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * math.log10(255**2 / float(((a - b) ** 2).mean()))


def drawn_after(page: Any, count: int) -> None:
    """Wait for another picture; the policy of the page forbids wait_for_function."""
    for _ in range(300):
        if page.evaluate("n => window.drawn > n", count):
            return
        page.wait_for_timeout(200)
    raise AssertionError("no picture within 60 s")


def test_the_page_plays_offline_and_draws_what_we_draw(
    loaded: LoadedRun, tmp_path: Path, window: Any
) -> None:
    path = write_page(loaded, tmp_path / "run.html").path
    opened = window(offline=True)
    page = opened.page
    page.goto(path.as_uri())
    drawn_after(page, 0)
    page.add_style_tag(content="#top, #bar, #about { display: none !important; }")
    drawing = RunDrawing(loaded)
    everything = frozenset(drawing.names)
    camera = loaded.clip.cameras[0]
    seen: dict[float, np.ndarray] = {}
    for frame in (0.0, 4.0, 4.5):
        before = page.evaluate("window.drawn")
        page.evaluate(
            "f => { const t = document.getElementById('time'); t.value = f;"
            " t.oninput({target: t}); }", frame,
        )  # fmt: skip
        drawn_after(page, before)
        seen[frame] = opened.pixels()
        from hoigs.core.values.between import camera_between, in_shape
        from hoigs.viewing.viewer.panes import covered

        view = in_shape(camera_between(loaded.clip, frame), 640, 480)
        ours = drawing.draw(frame, view, Look(entities=everything)).image.astype(np.float64)
        inside = covered(loaded.clip, view)
        assert psnr(seen[frame][inside], ours[inside]) > 30, frame
        assert seen[frame][~inside].max() == 0, "what lies beside the video's frame was never seen"
    assert camera.width > 0 and np.abs(seen[0.0] - seen[4.0]).max() > 30
    page.evaluate("document.getElementById('show-human').click()")
    page.wait_for_timeout(500)
    assert np.abs(opened.pixels() - seen[4.5]).max() > 30
    without = opened.pixels()
    page.mouse.move(320, 240)
    page.mouse.down()
    page.mouse.move(400, 250, steps=4)
    page.mouse.up()
    page.wait_for_timeout(500)
    assert np.abs(opened.pixels() - without).max() > 30
    assert opened.errors == []
