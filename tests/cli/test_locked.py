"""A run that another process writes is neither resumed nor replaced."""

from __future__ import annotations

import json
import os
import socket

import pytest

SMALL = ["--device", "cpu", "--set", "train.steps=2", "--set", "train.preview_every=0", "--no-eval",
         "--set", "model.scene.points=200"]  # fmt: skip


def test_a_run_that_is_being_trained(hoigs, tiny_clip, tmp_path):
    run = tmp_path / "run"
    arguments = ["train", tiny_clip, "--spec", "static", "--out", run, *SMALL]
    assert hoigs(*arguments).code == 0
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    lock = tmp_path / ".run.lock"
    lock.write_text(json.dumps({"work": "training", "host": socket.gethostname(),
                                "pid": os.getppid(), "token": "its"}))  # fmt: skip
    for words in (
        [*arguments, "--overwrite"],
        [*arguments, "--resume", "--set", "train.steps=9"],
        ["eval", run, "--device", "cpu"],
    ):
        outcome = hoigs(*words)
        assert outcome.code == 2 and "being written by another process" in outcome.err
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before
    lock.unlink()
    assert hoigs(*arguments, "--overwrite").code == 0
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_an_export_to_one_place_at_a_time(hoigs, tiny_clip, tmp_path):
    """What a killed export left is removed; one that is alive is not disturbed."""
    run, target = tmp_path / "run", tmp_path / "out"
    assert hoigs("train", tiny_clip, "--spec", "static", "--out", run, *SMALL).code == 0
    unfinished = tmp_path / ".out.1.part"
    unfinished.mkdir()
    lock = tmp_path / ".out.lock"
    lock.write_text(json.dumps({"work": "hoigs export", "host": socket.gethostname(),
                                "pid": os.getppid(), "token": "its"}))  # fmt: skip
    export = ["export", run, "--format", "ply", "--out", target, "--device", "cpu"]
    outcome = hoigs(*export)
    assert outcome.code == 2 and "being written by another process" in outcome.err
    assert unfinished.is_dir() and not target.exists()
    lock.unlink()
    assert hoigs(*export).code == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "run"]


@pytest.mark.parametrize("more", [[], ["--stage", "frames"]])
def test_a_clip_that_is_being_prepared(hoigs, tmp_path, more):
    source = tmp_path / "source"
    source.mkdir()
    (source / "video.mp4").write_bytes(b"")
    (tmp_path / ".clip.prepare.lock").write_text(
        json.dumps({"work": "hoigs prepare", "host": "elsewhere", "pid": 1, "token": "its"})
    )
    outcome = hoigs("prepare", source, "--out", tmp_path / "clip", *more)
    assert outcome.code == 2, outcome.err
    assert not (tmp_path / "clip.prepare").exists()
