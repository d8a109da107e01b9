"""Stages are kept and taken up again; what is killed leaves nothing half-written."""

from __future__ import annotations

import errno
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.errors import ClipError, HoigsError
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.draft import Draft
from hoigs.preparation.kept import PLAN, kept, last_kept, with_dependents
from hoigs.preparation.prepare import PrepareOptions, prepare, prepare_until, work_folder
from hoigs.preparation.stages import STAGES
from hoigs.preparation.video.source import Source
from hoigs.preparation.work_folder import Result, WorkFolder, digest, fingerprint

OPTIONS = PrepareOptions(fit_steps=3, overlay_width=0, max_frames=6)
REPOSITORY = Path(__file__).resolve().parents[3]
KILL = REPOSITORY / "benchmarks/kill_prepare.py"


def made(out: Path) -> dict[str, int]:
    """When each stage's result was made."""
    found = {name: work_folder(out) / name / "result.json" for name in PLAN}
    return {name: path.stat().st_mtime_ns for name, path in found.items() if path.is_file()}


def test_stages_are_taken_up_and_redone(tiny_source: Path, tmp_path: Path) -> None:
    out, body = tmp_path / "clip", AnnyBody()
    seconds = prepare_until("people", tiny_source, out, body=body, options=OPTIONS)
    assert list(seconds) == list(made(out)) == list(PLAN)[:5]
    assert not out.exists()
    first = made(out)
    report = prepare(tiny_source, out, body=body, options=OPTIONS)
    assert check_clip(out) == [] and set(report.seconds) == set(PLAN)
    assert {name: when for name, when in made(out).items() if name in first} == first
    assert report.seconds["people"] == seconds["people"], "as long as it took when it was made"
    assert "estimated from the person" in " ".join(report.warnings), "of a stage that did not run"
    # one stage anew, and what builds on it; the older clip is replaced
    before = made(out)
    again = prepare(tiny_source, out, body=body, options=OPTIONS, redo=["masks"])
    after = made(out)
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"masks", "objects", "scene"}
    assert again.warnings == report.warnings and again.coverage == report.coverage


def test_other_options_and_files_make_other_results(tiny_source: Path, tmp_path: Path) -> None:
    out, body = tmp_path / "clip", AnnyBody()
    prepare_until("masks", tiny_source, out, body=body, options=OPTIONS)
    before = made(out)
    black = OPTIONS.model_copy(update={"keep_black": True})
    prepare_until("masks", tiny_source, out, body=body, options=black)
    assert {name for name, when in made(out).items() if before[name] != when} == {"masks"}
    before = made(out)
    track = dict(np.load(tiny_source / "ball_track.npz"))
    track["xyr"][2] += 1
    np.savez(tiny_source / "ball_track.npz", **track)
    prepare_until("masks", tiny_source, out, body=body, options=black)
    changed = {name for name, when in made(out).items() if before[name] != when}
    assert changed == {"people", "masks"}


def test_older_results_and_other_classes_are_not_read(tiny_source: Path, tmp_path: Path) -> None:
    out, body = tmp_path / "clip", AnnyBody()
    prepare_until("frames", tiny_source, out, body=body, options=OPTIONS)
    file = work_folder(out) / "frames/result.json"
    content, text = json.loads(file.read_text()), file.read_text()
    assert last_kept(work_folder(out), "frames")["frames"].indices == list(range(6))
    content["values"]["format"] -= 1
    file.write_text(json.dumps(content))
    assert last_kept(work_folder(out), "frames") == {}
    file.write_text(text.replace('"FrameList"', '"WorkFolder"'))
    with pytest.raises(KeyError, match="WorkFolder"):
        last_kept(work_folder(out), "frames")


def test_a_model_made_in_the_work_folder_is_kept_with_the_result(tmp_path: Path) -> None:
    none = torch.zeros(0, 3)
    with WorkFolder(tmp_path / "work") as work:
        for model in (work.root / "unfinished/model", tmp_path / "given"):
            model.mkdir(parents=True)
            _write(model / "cameras.txt", model.name)
            draft = Draft(Source(tmp_path, tmp_path), tmp_path / "clip", AnnyBody(), work)
            track = CameraTrack([], none, none, "", metric=True, model=model)
            found = kept(
                draft,
                "frames",
                OPTIONS,
                lambda d=draft, t=track: d.noting(["!"], track=t),
                model.name,
            )
            assert found.warnings == ("!",) and draft.warnings == ()
            if model.name == "model":
                shutil.rmtree(model)
            else:
                assert found.track.model == model
            assert (found.track.model / "cameras.txt").read_text() == model.name


def test_what_builds_on_what() -> None:
    assert with_dependents(["scene"]) == {"scene", "write"}
    assert with_dependents(["frames"]) == set(PLAN) and list(STAGES) == list(PLAN)
    for name, stage in PLAN.items():
        assert set(stage.reads) <= set(list(PLAN)[: list(PLAN).index(name)])
        assert set(stage.options) <= set(PrepareOptions.model_fields)


def test_unknown_and_last_stages(tiny_source: Path, tmp_path: Path) -> None:
    with pytest.raises(HoigsError, match=r"camera.*cameras"):
        prepare(tiny_source, tmp_path / "clip", body=AnnyBody(), redo=["camera"])
    with pytest.raises(HoigsError, match="write is the last"):
        prepare_until("write", tiny_source, tmp_path / "clip", body=AnnyBody())


def test_one_process_at_a_time(tiny_source: Path, tmp_path: Path) -> None:
    out = tmp_path / "clip"
    held = {"work": "hoigs prepare", "host": "elsewhere", "pid": 1, "token": "its"}
    (tmp_path / ".clip.prepare.lock").write_text(json.dumps(held))
    with pytest.raises(ClipError, match=r"pid 1 on elsewhere"):
        prepare(tiny_source, out, body=AnnyBody(), options=OPTIONS)


def test_a_fault_after_long_work_keeps_it(tiny_source: Path, tmp_path: Path) -> None:
    out, body = tmp_path / "clip", AnnyBody()
    prepare_until("people", tiny_source, out, body=body, options=OPTIONS)
    (tiny_source / "hoi_mask/00002.png").unlink()
    with pytest.raises(HoigsError, match=r"hoi_mask.*1 of 6 .*2"):
        prepare(tiny_source, out, body=body, options=OPTIONS)
    assert "people" in made(out)


def test_results_survive_exactly_and_only_for_their_key(tmp_path: Path) -> None:
    values = {"third": 1 / 3, "none": None, "list": [1, 2.5, "x"]}
    array = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    with WorkFolder(tmp_path / "work") as work:
        work.save("a", "key", Result(values, {"x": array}, lambda f: _write(f / "note", "hi")))
        found = work.load("a", "key")
        assert found is not None and found.folder is not None
        assert found.values == values
        assert np.array_equal(found.arrays["x"], array) and found.arrays["x"].dtype == np.float32
        assert (found.folder / "note").read_text() == "hi"
        assert work.load("a", "other") is None and work.load("b", "key") is None
        work.save("a", "other", Result({"new": True}))
        assert work.load("a", "key") is None and not (found.folder / "note").exists()
        work.forget("a")
        assert work.load("a", "other") is None


@pytest.mark.parametrize("damage", [b"", b"[1]", b"{}", b'{"key": 1', b"\xff"])
def test_a_damaged_result_is_made_again(tmp_path: Path, damage: bytes) -> None:
    with WorkFolder(tmp_path / "clip.prepare") as work:
        work.save("depth", "k", Result({"a": 1}, {"x": np.zeros(3)}))
        for name in ("result.json", "arrays.npz"):
            path = tmp_path / "clip.prepare/depth" / name
            whole = path.read_bytes()
            path.write_bytes(damage)
            assert work.load("depth", "k") is None
            path.write_bytes(whole)
        assert work.load("depth", "k") is not None


@pytest.mark.parametrize("where", ["stage", "clip"])
def test_a_full_disk_is_named_and_leaves_nothing_half(
    tiny_source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "clip"
    if where == "stage":
        monkeypatch.setattr(np, "savez_compressed", full)
        with WorkFolder(tmp_path / "clip.prepare") as work, pytest.raises(OSError) as caught:
            work.save("depth", "k", Result({}, {}))
        assert not list((tmp_path / "clip.prepare").iterdir())
        assert caught.value.filename == str(tmp_path / "clip.prepare/depth")
    else:
        monkeypatch.setattr("hoigs.core.clip_folder.write.check_clip", full)
        with pytest.raises(OSError) as caught:
            prepare(tiny_source, out, body=AnnyBody(), options=OPTIONS)
        assert caught.value.filename == str(out)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["clip.prepare", "source"]


def test_leavings_of_a_killed_process_are_swept_away(tmp_path: Path) -> None:
    root = tmp_path / "work"
    (root / ".half").mkdir(parents=True)
    _write(root / ".half/result.json", json.dumps({"key": "key", "values": {}}))
    with WorkFolder(root) as work:
        assert not (root / ".half").exists()
        assert work.load(".half", "key") is None


def test_fingerprints_see_every_edit(tmp_path: Path) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    _write(folder / "0.png", "aaa")
    first = digest(fingerprint([folder]))
    _write(folder / "0.png", "abcd")
    second = digest(fingerprint([folder]))
    _write(folder / "1.png", "x")
    assert len({first, second, digest(fingerprint([folder]))}) == 3


def _write(path: Path, text: str) -> None:
    path.write_text(text)


def test_killed_at_random_moments() -> None:
    """Real processes, real SIGKILLs; benchmarks/kill_prepare.py does it as often as one likes."""
    done = subprocess.run(
        [sys.executable, str(KILL), "--times", "3", "--seed", "3"],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    match = re.match(r"3 kills in runs of .* (\d+) clips finished, (\d+) of them", done.stdout)
    assert match and int(match[1]) >= 1, done.stdout


def test_killed_while_its_environment_is_installed() -> None:
    done = subprocess.run(
        [sys.executable, str(KILL), "--install", "--times", "1", "--seed", "0"],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(r"1 kills? in runs of .* [1-9]\d* clips finished", done.stdout), done.stdout
