"""--html: what is stored comes back, sizes are kept, and the page draws what the library draws."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import hoigs
from hoigs.core.errors import HoigsError
from hoigs.core.maths.rotations import axis_angle_to_quats, multiply_quats, quats_to_matrices
from hoigs.core.values.gaussians import Gaussians
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.player.page import key_frames, packed, track_of, write_page
from hoigs.viewing.viewer.run_drawing import Look, RunDrawing

pytestmark = pytest.mark.usefixtures("one_thread")
EYES = [torch.tensor((0.0, 0.0, -4.0))]


@pytest.fixture(scope="module")
def loaded(tiny_run: Path) -> LoadedRun:
    return LoadedRun.open(tiny_run, device="cpu")


def cloud(count: int = 200) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(count, 3, generator=generator)
    made = Gaussians.from_points(points, torch.rand(count, 3, generator=generator), opacity=0.8)
    return made.replace(quats=torch.randn(count, 4, generator=generator))


def test_tracks_are_sorted_by_how_they_move() -> None:
    still = cloud()
    turns = [torch.tensor((0.0, 0.3 * i, 0.1)) for i in range(6)]

    def moved(turn: torch.Tensor) -> Gaussians:
        quat = axis_angle_to_quats(turn)
        return still.replace(
            means=still.means @ quats_to_matrices(quat).mT + turn,
            quats=multiply_quats(quat.expand(len(still), 4), still.quats),
        )

    assert track_of("a", [still] * 6, EYES).motion == "static"
    rigid = track_of("a", [moved(t) for t in turns], EYES)
    assert rigid.motion == "rigid" and rigid.poses is not None
    for pose, turn in zip(rigid.poses, turns, strict=True):
        placed = rigid.means[0] @ quats_to_matrices(pose[:4]).mT + pose[4:]
        assert torch.allclose(placed, moved(turn).means, atol=1e-4)
    bent = [still.replace(means=still.means * (1 + 0.05 * i)) for i in range(6)]
    assert track_of("a", bent, EYES).motion == "moving"
    turned = [moved(t) for t in turns]
    lit = [g.replace(sh=g.sh * (1 + 0.2 * i)) for i, g in enumerate(turned)]
    assert track_of("a", lit, EYES).motion == "moving"  # its light changes
    fading = [still.replace(opacity_logits=still.opacity_logits - i) for i in range(6)]
    assert track_of("a", fading, EYES).motion == "moving"


def test_packing_is_as_exact_as_it_says() -> None:
    """The differences summed up again, as the player does."""
    import gzip

    still = cloud()
    still = still.replace(sh=2 * still.sh)  # some colours are brighter than white
    frames = [still.replace(means=still.means * (1 + 0.05 * i)) for i in range(5)]
    track = track_of("a", frames, EYES)
    (head,), data = packed([track])
    codes = np.frombuffer(gzip.decompress(data), np.uint8)
    keys, count = len(frames), len(still)
    assert len(codes) == head["bytes"] == 17 * keys * count
    low, high = codes[: 6 * keys * count].reshape(2, keys, 3, count).astype(int)
    steps = np.cumsum(low + 256 * high, 0) % 65536
    span = np.array(head["high"]) - np.array(head["low"])
    means = np.array(head["low"])[:, None] + steps / 65535 * span[:, None]
    assert np.abs(means.transpose(0, 2, 1) - track.means.numpy()).max() <= span.max() / 65535
    rgba = np.cumsum(codes[-4 * keys * count :].reshape(keys, 4, count).astype(int), 0) % 256
    colors = (rgba[:, :3] / 255 * head["bright"]).transpose(0, 2, 1)
    assert head["bright"] > 1.2 and rgba[:, 3].min() > 0
    assert np.quantile(np.abs(colors - track.rgba[..., :3].numpy()), 0.99) <= head["bright"] / 255


def test_every_frame_is_reached_from_the_keys() -> None:
    for frames in (2, 9, 10, 64):
        for stride in (1, 2, 3, 4):
            kept = key_frames(frames, stride)
            assert kept[0] == 0 and kept[-1] == frames - 1
            assert kept[:-1] == [i * stride for i in range(len(kept) - 1)]  # as the player counts


def test_max_mb_is_kept_and_says_what_is_missing(loaded: LoadedRun, tmp_path: Path) -> None:
    whole = write_page(loaded, tmp_path / "whole.html")
    assert whole.gaussians == whole.of and whole.stride == 1
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
        from hoigs.core.values.between import camera_between
        from hoigs.viewing.viewer.panes import fitted

        view = fitted(camera_between(loaded.clip, frame), (640, 480))
        ours = drawing.draw(frame, view, Look(entities=everything)).image.astype(np.float64)
        assert psnr(seen[frame], ours) > 30, frame
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
