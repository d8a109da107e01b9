"""hoigs export: one file or a folder, whole or not at all; errors say what to do."""

from __future__ import annotations

import errno
import json
import math
import shutil
from pathlib import Path

import pytest
import trimesh
from exported_run import tiny_run

import hoigs as h
from hoigs.core.errors import HoigsError
from hoigs.core.values.between import frame_of
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.export import export_moments


def test_a_file_and_what_was_kept_beside_it(hoigs, tmp_path):
    done = hoigs(
        "export", tiny_run(), "--format", "ply", "--out", tmp_path / "x.ply", "--from", 5.5
    )
    assert done.code == 0, done.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.ply", "x.ply.json"]
    sheet = json.loads((tmp_path / "x.ply.json").read_text())
    assert sheet["frames"] == [5.5] and sheet["units"] == "metres" and "OpenCV" in sheet["axes"]
    assert sheet["entities"] == {"scene": "scene", "human": "human", "object": "object"}
    assert "scales" in sheet["kept"] and "the Gaussians' entities" in sheet["lost"]
    again = hoigs("export", tiny_run(), "--format", "ply", "--out", tmp_path / "x.ply")
    assert again.code == 2 and "exists and is not replaced" in again.err


def test_bad_input_is_answered_and_leaves_nothing(hoigs, tmp_path):
    run = tiny_run()
    cases = (
        ([run, "--format", "pyl"], 'did you mean "ply"?'),
        ([run, "--format", "ply", "--set", "ub=y"], "ub: unknown key (valid: up, pad_sh)"),
        ([run, "--format", "ply", "--entities", "hunan"], 'did you mean "human"?'),
        ([run, "--format", "ply", "--from", 8, "--to", 3], "--from 8 is behind --to 3"),
        ([run, "--format", "ply", "--slow", 0], "error: --slow 0: expected a positive number"),
        (
            [run, "--format", "bvh", "--entities", "object"],
            "--format bvh exports entities of kind human; it was given object (object)",
        ),
        ([tmp_path, "--format", "ply"], "not a run folder"),
    )
    for arguments, words in cases:
        done = hoigs("export", *arguments, "--out", tmp_path / "x.ply")
        assert done.code == 2 and words in done.err, (arguments, done.err)
    assert not list(tmp_path.iterdir())


def test_feet_stand_at_zero_in_a_run_of_a_tilted_video(tmp_path):
    """The cameras of built-in clips look down by nine degrees; their floor is known."""
    done = h.export(
        tiny_run(), format="mesh-sequence", out=tmp_path / "m", entities=["human"], end=0
    )
    mesh = trimesh.load(tmp_path / "m" / "human" / "frame_0000.ply", process=False, force="mesh")
    low, high = mesh.bounds[:, 1]
    assert abs(low) < 0.03 and 1.0 < high < 1.9
    assert not done.supposed
    world = json.loads((tmp_path / "m" / "export.json").read_text())["world"]
    assert world == {
        "up": [0, 1, 0], "floor": 0, "metres": True, "known": "given", "within": None,
    }  # fmt: skip


@pytest.mark.parametrize("bodies", [True, False])
def test_without_a_known_floor_up_is_the_bodys_or_a_guess_that_is_said(bodies, tmp_path, hoigs):
    """A folder of before there was a world, as of a video: bodies tell up; cameras would guess."""
    clip = shutil.copytree(clip_of(tiny_run()), tmp_path / "clip")
    header = json.loads((clip / "clip.json").read_text())
    del header["world"], header["provenance"]["generator"]
    if not bodies:
        del header["entities"]["human"]
    (clip / "clip.json").write_text(json.dumps(header))
    read = h.read_clip(clip)
    tilt = math.degrees(math.acos(float(read.up()[1])))
    if bodies:
        assert read.world.known in ("body", "floor") and tilt < 3
        assert abs(read.world.floor) < 0.04
        return
    assert read.world.is_guess and 7 < tilt < 11
    small = ["--set", "train.steps=2", "--set", "model.scene.points=60", "--no-eval"]
    run = tmp_path / "run"
    assert hoigs("train", clip, "--spec", "static", *small, "--out", run).code == 0
    for settings, said in ((["--set", "up=y"], True), ([], False)):
        out = tmp_path / f"{said}.ply"
        done = hoigs("export", run, "--format", "ply", "--out", out, *settings)
        assert done.code == 0 and ("supposed: up:" in done.out) == said
        sheet = json.loads((tmp_path / f"{said}.ply.json").read_text())
        assert ("up" in sheet["supposed"]) == said
        assert sheet["world"]["known"] == "cameras (guess)"


def clip_of(run: Path) -> Path:
    record = json.loads((run / "provenance.json").read_text())
    return (run / record["clip"]["path"]).resolve()


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for out in (tmp_path / "x.ply", tmp_path / "folder"):
        with pytest.raises(HoigsError, match="No space left on device"):
            h.export(tiny_run(), format="ply", out=out)
    with pytest.raises(HoigsError, match=r"x\.html cannot be written: No space left on device"):
        h.view(tiny_run(), html=tmp_path / "x.html", device="cpu")
    assert not list(tmp_path.iterdir())


def test_a_run_without_checkpoint(tmp_path):
    shutil.copytree(tiny_run(), tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    with pytest.raises(HoigsError, match="checkpoints"):
        h.export(tmp_path / "run", format="ply", out=tmp_path / "x.ply")
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_moments_between_frames():
    clip = LoadedRun.open(tiny_run()).clip
    moments, fps = export_moments(clip, 2, 4, None, 4.0)
    assert fps == clip.fps
    assert [frame_of(clip, m) for m in moments] == pytest.approx([2 + i / 4 for i in range(9)])
    assert moments[4].poses is clip.moments[3].poses  # a whole frame keeps its pose
    low, high = (clip.moments[i].poses["human"].transl for i in (2, 3))
    assert moments[1].poses["human"].transl.allclose(0.75 * low + 0.25 * high, atol=1e-6)
    faster, fps = export_moments(clip, None, None, 2 * clip.fps, 1.0)
    assert len(faster) == 23 and fps == 2 * clip.fps
