"""The report: whole, self-contained, escaped, and true to its inputs."""

from __future__ import annotations

import base64
import io
import json
import math
import re
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hoigs.core.errors import HoigsError
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.report import write_report
from hoigs.evaluation.report.curves import smoothed
from hoigs.evaluation.report.media import contact_sheet, evenly, key_position, within
from hoigs.evaluation.report.sections import clock, short
from hoigs.evaluation.report.write import in_shell
from hoigs.runs.run_folder import RunFolder

VOID = {"meta", "img", "input", "br"}


class Balance(HTMLParser):
    """Fails on a tag that is closed out of order or never."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs) -> None:
        pass

    def handle_endtag(self, tag) -> None:
        assert self.open and self.open[-1] == tag, (self.open[-3:], tag)
        self.open.pop()

    def handle_data(self, data) -> None:
        self.text.append(data)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "spec.yaml").write_text("name: toy # <tricky> & $title\n")
    (tmp_path / "provenance.json").write_text(
        json.dumps({
            "versions": {"torch": "9.9.9"}, "clip": {"path": f"../..{Path.home()}/clip"},
            "command": f"hoigs train {Path.home()}/clip --out {Path.home()}",
        })
    )  # fmt: skip
    lines = []
    for step in range(25, 1001, 25):
        decay = math.exp(-step / 300)
        record = {
            "step": step, "time_s": 0.1 * step, "loss": 0.1 + decay,
            "losses": {"scene": 0.1 + decay, "human/man": decay, "regularizer/man/tv": 0.0},
            "counts": {"wall": 500, "man": 160 + step, "ball": 60},
        }  # fmt: skip
        if step % 100 == 0:
            record["psnr"] = {"train": 30 - decay, "test": 28 - decay}
        lines.append(json.dumps(record))
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_the_page_is_whole_and_needs_nothing_else(run: Path, model: SceneModel, clip: Clip) -> None:
    model.train()
    named = replace(clip, name="<b>&toy</b>")
    evaluation = score(model, named, timing_frames=3, timing_warmup=0)
    (run / "renders").mkdir()
    (run / "renders/a b.mp4").touch()
    path = write_report(run, model, named, evaluation)
    assert model.training
    assert sorted(p.name for p in run.iterdir()) == [
        "metrics.jsonl", "provenance.json", "renders", "report.html", "spec.yaml",
    ]  # fmt: skip
    page = path.read_text()
    assert len(page) < 8_000_000
    parser = Balance()
    parser.feed(page)
    assert parser.open == []
    text = "".join(parser.text)
    assert "<b>&toy</b>" in text and "name: toy # <tricky> & $title" in text
    sources = re.findall(r"src=['\"]([^'\"]*)", page)
    assert sources and all(s.startswith("data:") for s in sources)
    linked = [link for link in re.findall(r"href=['\"]([^'\"]*)", page) if link[0] != "#"]
    assert linked == ["metrics.jsonl", "provenance.json", "renders/a%20b.mp4", "spec.yaml"]
    assert not re.search(r"url\((?!#)|@import", page)
    for expected in ("9.9.9", "1,000 steps", "LPIPS not computed", "held-out cameras", "1:40"):
        assert expected in text
    head = text[: text.index("Frames outside training")]
    assert "Method toy" in head and "man: " in head
    assert "hoigs train ~/clip --out ~" in head
    assert str(Path.home()).strip("/") + "/clip" not in page
    for command in (f"hoigs view {run}", f"hoigs export {run}"):
        assert command in text
    for region in ("human_object", "full"):
        assert f"{evaluation.score(region, 'psnr'):.2f} dB" in text
        assert f"<td>{evaluation.score(region, 'psnr'):.2f}</td>" in evaluation._repr_html_()


def pictures_of(html: str) -> list[Image.Image]:
    encoded = re.findall(r"data:image/webp;base64,([A-Za-z0-9+/=]+)", html)
    return [Image.open(io.BytesIO(base64.b64decode(data))) for data in encoded]


def test_its_pictures_show_the_clip(run: Path, model: SceneModel, clip: Clip) -> None:
    evaluation = score(model, clip, timing_frames=0)
    page = write_report(run, model, clip, evaluation).read_text()
    players = [part[: part.index("</div>")] for part in page.split("<div class='player")[1:]]
    playback, sequence, orbit = map(pictures_of, players)
    assert (len(playback), len(orbit)) == (8, 36)
    assert all(f"max='{count - 1}'" in part for part, count in zip(players, (8, len(sequence), 36)))
    # the model is the truth: both halves of the playback agree, in every frame
    for shown in playback:
        left, right = np.split(np.asarray(shown.convert("RGB")).astype(float), 2, 1)
        assert np.abs(left - right).mean() < 6
    scored = [f for v in evaluation.views if v.name != "held-out cameras" for f in v.frames]
    assert len(sequence) == len(scored) and "hoigs export" in page
    row = np.asarray(sequence[0].convert("RGB")).astype(float)
    video, render, error = np.split(row, 3, 1)
    assert np.abs(video - render).mean() < 6 and error.mean() < 40
    ends = re.findall(r"class='colors'>([^<]+)<i style='background:linear[^<]*</i>([^<]+)<", page)
    assert ("0 ", " 0.25") in ends and any(near.endswith(" m ") for near, _ in ends)
    cutouts = [p for p in pictures_of(page) if p.mode == "RGBA"]
    assert len(cutouts) == 3
    opacity = [np.asarray(p)[..., 3].mean() for p in cutouts]
    assert opacity[0] > 240 and 5 < opacity[1] < 120 and 1 < opacity[2] < 60


@pytest.mark.parametrize("place", ["here", "home", "elsewhere"])
def test_its_commands_name_the_run_from_the_folder_where_it_was_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    folder = tmp_path / place / "my run"
    folder.mkdir(parents=True)
    word = in_shell(folder)
    found = subprocess.run(
        f"cd {word} && pwd", shell=True, capture_output=True, text=True, check=False
    )
    assert found.stdout.strip() == str(folder), (word, found.stderr)
    assert (str(tmp_path) in word) == (place == "elsewhere")
    assert in_shell(Path("../elsewhere")) == str(tmp_path / "elsewhere")
    assert in_shell(Path()) == str(tmp_path / "here")


def test_a_clip_that_only_held_out_cameras_score(run: Path, model: SceneModel, clip: Clip) -> None:
    evaluation = score(model, clip, timing_frames=0)
    alone = replace(evaluation, views=[v for v in evaluation.views if "held-out" in v.name])
    assert alone.views
    page = write_report(run, model, clip, alone).read_text()
    assert "Held-out camera" in page and "In a row" not in page


def test_a_bare_folder_says_what_is_absent(tmp_path: Path, model: SceneModel, clip: Clip) -> None:
    evaluation = score(model, clip, timing_frames=0, held_out=False)
    page = write_report(tmp_path, model, clip, evaluation).read_text()
    assert "Absent: provenance.json, spec.yaml." in page
    assert "metrics.jsonl is absent" in page and "timing_frames is 0" in page


def test_damaged_metrics_name_the_line_and_leave_no_page(
    run: Path, model: SceneModel, clip: Clip
) -> None:
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"step": 1025, "lo\n')
    with pytest.raises(HoigsError, match=r"metrics\.jsonl:41"):
        write_report(run, model, clip, score(model, clip, timing_frames=0))
    assert not (run / "report.html").exists()


def test_a_line_that_is_still_being_written_is_left_out(run: Path) -> None:
    before = RunFolder(run).read_metrics()
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"step": 1025, "lo')
    assert RunFolder(run).read_metrics() == before != []
    assert RunFolder(run / "absent").read_metrics() == []


def test_key_moment_is_where_man_and_ball_meet(clip: Clip) -> None:
    assert key_position(clip) >= 5  # the ball swings towards the man
    alone = replace(clip, kinds={"man": "human"})
    assert key_position(alone) == len(clip) // 2


def test_moving_pictures_shrink_until_they_fit() -> None:
    generator = np.random.default_rng(0)
    noise = [
        Image.fromarray(generator.integers(0, 255, (64, 64, 3), dtype=np.uint8)) for _ in range(4)
    ]
    generous, tight = within(noise, 10**9), within(noise, 1)
    assert sum(map(len, tight)) < 0.6 * sum(map(len, generous))


def test_contact_sheet_is_video_above_render(tmp_path: Path, model: SceneModel, clip: Clip) -> None:
    path = contact_sheet(model, clip, [1, 5], tmp_path / "docs" / "sheet.png", tile_width=48)
    sheet = np.asarray(Image.open(path).convert("RGB")).astype(float)
    assert sheet.shape == (2 * 18 + 2 * 26 + 2 * 32 + 6, 2 * 18 + 26 + 2 * 48 + 6, 3)
    top, left = 18 + 52, 18 + 26
    video = sheet[top : top + 32, left : left + 48]
    render = sheet[top + 38 : top + 70, left : left + 48]
    assert np.abs(video - clip[1].image.numpy()).max() == 0
    assert np.abs(video - render).max() <= 1
    assert [p.name for p in path.parent.iterdir()] == ["sheet.png"]
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet(model, clip, [], tmp_path / "none.png")


def test_small_words() -> None:
    assert [clock(s) for s in (7.2, 59.7, 307, 7500)] == ["7 s", "1:00", "5:07", "2:05:00"]
    assert [short(n) for n in (812, 12_345, 2_500_000)] == ["812", "12.3k", "2.50M"]
    assert evenly(range(100), 4) == [12, 37, 62, 87]
    assert evenly([1, 2], 4) == [1, 2]
    assert smoothed([2.0, 2.0, 2.0]) == pytest.approx([2.0, 2.0, 2.0])
