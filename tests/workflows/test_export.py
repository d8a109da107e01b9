"""hoigs export: one file or a folder, whole or not at all; errors say what to do."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import pytest
from exported_run import tiny_run

import hoigs as h
from hoigs.core.errors import HoigsError
from hoigs.core.values.between import frame_of
from hoigs.runs.loaded_run import LoadedRun
from hoigs.workflows.export import export_moments


def test_a_file_and_what_was_kept_beside_it(hoigs, tmp_path):
    done = hoigs(
        "export", tiny_run(), "--format", "ply", "--out", tmp_path / "x.ply", "--from", 5.5
    )
    assert done.code == 0, done.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.ply", "x.ply.json"]
    sheet = json.loads((tmp_path / "x.ply.json").read_text())
    assert sheet["frames"] == [5.5] and sheet["units"] == "metres" and "OpenCV" in sheet["axes"]
    assert sheet["entities"] == {"scene": "scene", "human": "human", "object": "object"}
    assert "scales" in sheet["kept"] and "entities" in sheet["lost"]
    again = hoigs("export", tiny_run(), "--format", "ply", "--out", tmp_path / "x.ply")
    assert again.code == 2 and "exists and is not replaced" in again.err


def test_bad_input_is_answered_and_leaves_nothing(hoigs, tmp_path):
    run = tiny_run()
    cases = (
        ([run, "--format", "pyl"], 'did you mean "ply"?'),
        ([run, "--format", "ply", "--set", "ub=y"], "ub: unknown key (valid: up)"),
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
    import shutil

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
