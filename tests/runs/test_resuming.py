"""A run that goes on needs its folder alone; what is given stands in place of what it has."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from small_clip import small_clip

from hoigs.core.clip_folder.write import write_clip
from hoigs.core.errors import CheckpointError, ClipError, HoigsError, SpecError
from hoigs.core.registry.registry import default_registry
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.resuming import default_out, load_spec
from hoigs.training.session import Session

SETTINGS = ["train.steps=2", "train.log_every=1", "train.preview_every=0"]


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    small = small_clip()
    small.split["test"].append(small.split["train"].pop())
    write_clip(small, tmp_path / "small")
    return tmp_path / "small"


@pytest.fixture
def run(clip: Path, tmp_path: Path) -> Path:
    Session.open(clip, "static", out=tmp_path / "run", overrides=SETTINGS).train()
    return tmp_path / "run"


@pytest.mark.parametrize("name", ["a\0b", "a\x1b[2J", "a\udce9"])
def test_names_that_no_record_holds_are_refused_before_training(tmp_path: Path, name: str) -> None:
    for changes in ({"name": name}, {"kinds": {name: "object"}}):
        with pytest.raises(ClipError, match="name") as caught:
            replace(small_clip(), **changes)
        assert repr(name) in str(caught.value)


def test_paths_that_no_record_holds_are_refused_before_training(clip: Path, tmp_path: Path) -> None:
    strange = clip.rename(tmp_path / os.fsdecode(b"caf\xe9"))
    with pytest.raises(HoigsError, match=r"caf\\udce9"):
        Session.open(strange, "static", out=tmp_path / "run", overrides=SETTINGS)
    assert [p.name for p in tmp_path.iterdir()] == [strange.name]


@pytest.mark.parametrize("name", ["x/../../../evil", "x\0y"])
def test_a_run_is_never_made_outside_of_runs(name: str) -> None:
    with pytest.raises(HoigsError, match="name the run folder: --out RUN"):
        default_out("builtin:carry", name)
    assert default_out("builtin:carry", "hoigs@matched") == Path("runs/carry-hoigs@matched")


def test_a_run_goes_on_by_its_own_spec_and_clip(run: Path) -> None:
    again = Session.open(out=run, resume=True)
    assert (again.spec.name, again.spec.train.steps, again.trainer.step) == ("static", 2, 2)
    assert again.clip.name == "small" and again.changes == []


def test_what_is_given_is_laid_over_and_told(run: Path) -> None:
    longer = Session.open(out=run, resume=True, overrides=["train.steps=4"])
    assert longer.changes == ["train.steps: 2 -> 4"]
    longer.train()
    assert LoadedRun.open(run).step == 4
    named = Session.open(spec="static", out=run, resume=True, overrides=SETTINGS)
    assert named.changes == ["train.steps: 4 -> 2"]


def test_another_model_is_refused_and_the_run_stays(run: Path) -> None:
    before = (run / "spec.yaml").read_text()
    with pytest.raises(CheckpointError, match="model hash"):
        Session.open(out=run, resume=True, overrides=["model.scene.sh_degree=1"])
    assert (run / "spec.yaml").read_text() == before


def test_a_clip_that_moved_is_named_once(run: Path, clip: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere" / "small"
    shutil.move(clip, moved)
    with pytest.raises(HoigsError, match="the clip of this run is not there"):
        Session.open(out=run, resume=True)
    Session.open(moved, out=run, resume=True)
    assert LoadedRun.open(run).clip.name == "small"


def test_faults_that_were_allowed_stay_allowed(run: Path, clip: Path, tmp_path: Path) -> None:
    min((clip / "images").iterdir()).write_bytes(b"torn")
    with pytest.raises(HoigsError):
        Session.open(clip, "static", out=tmp_path / "strict", overrides=SETTINGS)
    out = tmp_path / "lenient"
    Session.open(clip, "static", out=out, overrides=SETTINGS, allow_faults=True)
    assert Session.open(out=out, resume=True).faults


def test_no_clip_and_no_run_is_answered(tmp_path: Path) -> None:
    for wanted in ({"out": tmp_path / "run"}, {"resume": True}, {}):
        with pytest.raises(HoigsError, match="name a clip"):
            Session.open(**wanted)
    assert not list(tmp_path.iterdir())


def test_an_absent_plugin_file_is_named(tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    spec.write_text("extends: hoigs\nrasterizer: {use: 'rasterizer:acme'}\n")
    part = {"dist": "acme.py", "key": "rasterizer:acme@acme.py"}
    record = {"clip": {"path": "clip"}, "components": {"rasterizer": part}}
    (tmp_path / "provenance.json").write_text(json.dumps(record))
    with pytest.raises(SpecError, match=r"\nthis run was trained with --plugin acme\.py: give it"):
        load_spec(spec, (), default_registry())
