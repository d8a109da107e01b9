"""builtin:NAME wherever a clip is asked for; a run goes on with another density cap."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

from hoigs.core.errors import ClipError
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


def test_a_copy_of_a_run_finds_its_built_in_clip(hoigs, tmp_path):
    """By a path to where the run was once, it is not there."""
    run, copy = tmp_path / "run", tmp_path / "of/another/depth/copy"
    assert hoigs("train", TINY, "--out", run, "--set", "train.steps=2", *QUICK).code == 0
    shutil.copytree(run, copy)
    assert LoadedRun.open(copy).clip.name == LoadedRun.open(run).clip.name
    done = hoigs("train", "--resume", "--out", copy, "--set", "train.steps=3", "--no-eval")
    assert done.code == 0, done.err


@pytest.mark.parametrize("changed", ["generator", "config"])
def test_a_built_in_clip_of_another_version_is_not_put_in_its_place(hoigs, tmp_path, changed):
    run = tmp_path / "there/run"
    assert hoigs("train", TINY, "--out", run, "--set", "train.steps=2", *QUICK).code == 0
    copy = shutil.copytree(run, tmp_path / "copy")
    record = json.loads((copy / "provenance.json").read_text())
    record["clip_provenance"][changed] = "another"
    (copy / "provenance.json").write_text(json.dumps(record))
    with pytest.raises(ClipError, match="the clip of this run is not there") as refused:
        LoadedRun.open(copy)
    assert "/../" not in str(refused.value)


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
