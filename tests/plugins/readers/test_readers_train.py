"""`hoigs train FOLDER` on a data set: the reader is found, told, and kept with the run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from layouts import behave, colmap, hosnerf
from layouts.anny_models import write_model
from layouts.changed import without_fingers
from typer.testing import CliRunner

from hoigs.cli.main import app
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.smpl import SmplBody, SmplhBody

SMALL = ["--set", "train.steps=1", "--set", "train.preview_every=0", "--rasterizer", "torch",
         "--device", "cpu", "--no-eval"]  # fmt: skip


@pytest.mark.slow
def test_a_person_and_an_object_of_behave(still: Clip, tmp_path: Path) -> None:
    model = write_model(tmp_path / "male" / "model.npz", "smplh")
    pelvis = SmplhBody(SmplhBody.Config(path=model)).shaped(still.bodies["human"].poses.betas)[1][0]
    folder, _ = behave.write(still, tmp_path / "data", pelvis, kinects=(1,))
    args = ["train", str(folder), "--out", str(tmp_path / "run"), *SMALL]
    bare = CliRunner().invoke(app, args)
    assert "is a body:smplh: add `body" in bare.output
    few = ["--reader-set", "points=50", "--reader-set", "object_points=40"]
    body = ["--set", "model.human.body.use=body:smplh", "--set", f"model.human.body.path={model}"]
    done = CliRunner().invoke(app, [*args, *few, *body])
    assert done.exit_code == 0, done.output
    assert f"on {behave.NAME} (reader:behave)" in done.output
    provenance = json.loads((tmp_path / "run" / "provenance.json").read_text())
    assert provenance["clip"]["reader"] == {
        "use": "reader:behave", "settings": {"object_points": 40, "points": 50}
    }  # fmt: skip


@pytest.mark.slow
def test_the_scene_alone_of_hosnerf_and_its_settings(builtin: Clip, tmp_path: Path) -> None:
    model = write_model(tmp_path / "SMPL_NEUTRAL.npz", "smpl")
    folder = tmp_path / "scene"
    hosnerf.write(without_fingers(builtin), folder, SmplBody(SmplBody.Config(path=model)))
    run = tmp_path / "run"
    args = ["train", str(folder), "--out", str(run), *SMALL, "--spec", "static"]
    settings = ["--reader", "hosnerf", "--reader-set", f"smpl={model}", "--reader-set", "points=50"]
    done = CliRunner().invoke(app, [*args, *settings])
    assert done.exit_code == 0, done.output
    kept = json.loads((run / "provenance.json").read_text())["clip"]["reader"]
    assert kept == {
        "use": "reader:hosnerf", "settings": {"points": 50, "smpl": "../SMPL_NEUTRAL.npz"}
    }  # fmt: skip
    from hoigs.runs.loaded_run import LoadedRun

    assert LoadedRun.open(run).clip.bodies["human"].model == "body:smpl"


def test_a_reader_that_does_not_fit_says_what_is_absent(builtin: Clip, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    colmap.write(builtin, folder)
    args = ["train", str(folder), "--out", str(tmp_path / "run"), *SMALL, "--reader", "hosnerf"]
    refused = CliRunner().invoke(app, args)
    assert not (tmp_path / "run").exists()
    assert "mesh_infos.pkl" in refused.output
