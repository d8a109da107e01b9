"""builtin:NAME wherever a clip is asked for; a run goes on with another density cap."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from hoigs.runs.loaded_run import LoadedRun

TINY = "builtin:carry?frames=8&width=32&held_out_views=0&test_frames=2&samples=1&edge_samples=1"
QUICK = ("--spec", "static", "--set", "train.preview_every=0", "--no-eval",
         "--set", "model.scene.points=300")  # fmt: skip


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> Path:
    folder = tmp_path_factory.getbasetemp() / "hoigs-cache"
    monkeypatch.setenv("HOIGS_CACHE", str(folder))
    return folder


def test_a_named_clip_is_trained_on_and_read_back(hoigs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = hoigs("train", TINY, "--set", "train.steps=2", *QUICK)
    assert done.code == 0, done.err
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name.startswith("carry-frames-8-")
    for clip in (None, TINY):
        assert len(LoadedRun.open(run, clip=clip).clip.split["test"]) == 2


def test_a_wrong_name_is_answered_with_the_nearest(hoigs, tmp_path):
    failed = hoigs("train", "builtin:cary", "--out", tmp_path / "run")
    assert failed.code == 2 and 'did you mean "builtin:carry"?' in failed.err
    assert not (tmp_path / "run").exists()


def test_a_run_goes_on_with_another_cap_but_not_with_other_tensors(hoigs, tmp_path):
    run = tmp_path / "run"
    assert hoigs("train", TINY, "--out", run, "--set", "train.steps=2", *QUICK).code == 0
    longer = ("--resume", "--set", "train.steps=4", *QUICK)
    wider = hoigs("train", TINY, "--out", run, "--set", "model.scene.sh_degree=1", *longer)
    assert wider.code == 2 and "model hash" in wider.err
    done = hoigs("train", TINY, "--out", run, "--set", "model.scene.density.cap=40000", *longer)
    assert done.code == 0, done.err
    assert (run / "checkpoints" / "step_000004.json").exists()
    spec = yaml.safe_load((run / "spec.yaml").read_text())
    assert spec["train"]["steps"] == 4 and spec["model"]["scene"]["density"]["cap"] == 40000
