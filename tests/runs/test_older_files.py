"""Clip and run folders that version 0.1 wrote before names and files moved still open."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest
import yaml

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.errors import CheckpointError
from hoigs.evaluation.evaluate import score
from hoigs.runs.loaded_run import LoadedRun
from hoigs.training.session import Session

WRITTEN = Path(__file__).resolve().parents[1] / "fixtures" / "written_by_0_1"
# `hoigs eval` of the code that wrote the run: PSNR of whole test frames, dB
PSNR = 11.801479


def test_the_clip_folder_is_whole() -> None:
    assert check_clip(WRITTEN / "clip") == []


@pytest.mark.parametrize(("run", "tolerance"), [("run", 0.002), ("run-compact", 0.05)])
def test_a_run_opens_and_scores_as_it_did(run: str, tolerance: float) -> None:
    loaded = LoadedRun.open(WRITTEN / run)
    assert loaded.clip.bodies["human"].model == "body:anny-rig"
    result = score(loaded.model, loaded.clip, timing_frames=0)
    assert result.score("full", "psnr") == pytest.approx(PSNR, abs=tolerance)


def test_a_run_can_be_resumed(tmp_path: Path) -> None:
    shutil.copytree(WRITTEN, tmp_path / "written")
    run = tmp_path / "written" / "run"
    session = Session.open(out=run, resume=True, overrides=["train.steps=8"])
    session.train()
    assert LoadedRun.open(run).step == 8


def test_a_run_of_before_a_setting_was_there_still_opens(tmp_path: Path) -> None:
    shutil.copytree(WRITTEN, tmp_path / "written")
    run = tmp_path / "written" / "run"
    Session.open(out=run, resume=True, overrides=["train.steps=8"]).train()
    spec = run / "spec.yaml"
    older = re.sub(r"\n *upsample: false", "", spec.read_text())
    assert older != spec.read_text()
    spec.write_text(older)
    sections = {key: yaml.safe_load(older)[key] for key in ("interaction", "entities", "model")}
    for block in sections["model"].values():
        for key in ("density", "opacity", "thickness"):
            del block[key]
    taken = hashlib.sha256(json.dumps(sections, sort_keys=True).encode()).hexdigest()
    for file in (run / "checkpoints").glob("*.json"):
        meta = json.loads(file.read_text())
        file.write_text(json.dumps({**meta, "model_hash": taken}))
    assert LoadedRun.open(run).step == 8
    session = Session.open(out=run, resume=True, overrides=["train.steps=9"])
    session.train()
    assert LoadedRun.open(run).step == 9
    spec.write_text(re.sub(r"\bsh_degree: \d", "sh_degree: 3", older))
    with pytest.raises(CheckpointError, match="was made by the spec"):
        LoadedRun.open(run)
