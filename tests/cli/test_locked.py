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
    for more in (["--overwrite"], ["--resume", "--set", "train.steps=9"]):
        outcome = hoigs(*arguments, *more)
        assert outcome.code == 2 and "being written by another process" in outcome.err
    assert {p: p.read_bytes() for p in run.rglob("*") if p.is_file()} == before
    lock.unlink()
    assert hoigs(*arguments, "--overwrite").code == 0
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


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
