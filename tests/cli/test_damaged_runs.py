"""Damaged run folders: the file and its fault are named, exit code 2, nothing is scored."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from small_clip import small_clip

from hoigs.core.clip_folder.write import write_clip
from hoigs.training.session import Session

SETTINGS = ["train.steps=4", "train.checkpoint_every=2", "train.log_every=1",
            "train.preview_every=0"]  # fmt: skip
META, WEIGHTS = "checkpoints/step_000004.json", "checkpoints/step_000004.safetensors"


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    small = small_clip()
    small.split["test"].append(small.split["train"].pop())
    write_clip(small, folder / "small")
    Session.open(folder / "small", "static", out=folder / "run", overrides=SETTINGS).train()
    return folder


@pytest.fixture
def run(trained, tmp_path) -> Path:
    shutil.copytree(trained, tmp_path / "all")
    return tmp_path / "all" / "run"


def changed(file: str, **keys: object) -> Callable[[Path], None]:
    """Set keys of a JSON file; `...` removes one."""

    def damage(run: Path) -> None:
        content = json.loads((run / file).read_text()) | keys
        (run / file).write_text(json.dumps({k: v for k, v in content.items() if v is not ...}))

    return damage


def text(file: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda run: (run / file).write_bytes(data) and None


def weights(name: str, value: float | None = None) -> Callable[[Path], None]:
    """Set one number of a tensor, or remove the tensor."""

    def damage(run: Path) -> None:
        tensors = load_file(run / WEIGHTS)
        tensors[name].view(-1)[7] = 0.0 if value is None else value
        if value is None:
            del tensors[name]
        save_file(tensors, run / WEIGHTS)

    return damage


DEEP = "[" * 100_000 + "]" * 100_000
DAMAGES = {
    "NaN weights": (weights("model.entities.scene.means", torch.nan), "NaN or infinite"),
    "infinite weights": (weights("model.entities.scene.means", torch.inf), "NaN or infinite"),
    "a tensor is gone": (weights("model.entities.scene.sh"), "model alone has entities.scene.sh."),
    "cut weights": (lambda run: text(WEIGHTS, (run / WEIGHTS).read_bytes()[:400])(run), "damaged"),
    "huge count": (changed(META, counts={"scene": 10**12}), "counts.scene"),
    "large count": (changed(META, counts={"scene": 10**8}), "100000000 Gaussians of 'scene'"),
    "negative count": (changed(META, counts={"scene": -5}), "counts.scene"),
    "text count": (changed(META, counts={"scene": "many"}), "counts.scene"),
    "meta is a list": (text(META, "[1, 2]"), "expected an object"),
    "binary meta": (text(META, b"\xff\xfe\x00"), "not text in UTF-8"),
    "deep meta": (text(META, DEEP), "nested too deeply"),
    "no step": (changed(META, step=...), "step: Field required"),
    "no hash": (changed(META, model_hash=...), "model_hash: Field required"),
    "provenance is a list": (text("provenance.json", "[]"), "provenance.json: damaged"),
    "no clip": (changed("provenance.json", clip=...), "clip: Field required"),
    "clip of a type": (changed("provenance.json", clip=7), "provenance.json: damaged: clip"),
    "clip of NUL": (changed("provenance.json", clip={"path": "a\0b"}), "clip.path"),
    "deep provenance": (text("provenance.json", DEEP), "nested too deeply"),
    "reader of a type": (
        changed("provenance.json", clip={"path": "../small", "reader": {"use": 3}}), "clip.reader"
    ),
    "binary spec": (text("spec.yaml", b"\xff\xfe\x00"), "spec.yaml"),
    "deep spec": (text("spec.yaml", "a: " + DEEP), "nested too deeply"),
    "metrics of numbers": (text("metrics.jsonl", "7\n"), "metrics.jsonl:1"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_damaged_is_named(hoigs, run, name):
    damage, words = DAMAGES[name]
    damage(run)
    outcome = hoigs("eval", run, "--device", "cpu")
    assert outcome.code == 2 and outcome.err.startswith("error: "), outcome.err
    assert words in outcome.err and len(outcome.err) < 2000, outcome.err
    assert not (run / "report.html").exists()


def test_a_broken_newest_checkpoint_names_the_one_before(hoigs, run):
    weights("model.entities.scene.means", torch.nan)(run)
    for command in (["eval", run], ["train", "--resume", "--out", run, "--no-eval"]):
        outcome = hoigs(*command, "--device", "cpu")
        assert outcome.code == 2 and "The checkpoint of step 2 is whole" in outcome.err
        assert f"remove {run / META}" in outcome.err
    (run / META).unlink()
    assert hoigs("train", "--resume", "--out", run, "--no-eval", "--device", "cpu").code == 0
    assert (run / META).is_file()


@pytest.mark.parametrize(
    "damage",
    [
        changed(META, sampler={"queue": [77]}),
        changed(META, sampler=...),
        weights("rng.generator"),
        weights("optimizer.entities.scene.means.exp_avg", torch.nan),
    ],
)
def test_a_state_that_cannot_be_resumed(hoigs, run, damage):
    damage(run)
    before = (run / "metrics.jsonl").read_bytes()
    outcome = hoigs("train", "--resume", "--out", run, "--no-eval", "--device", "cpu",
                    "--set", "train.steps=6")  # fmt: skip
    assert outcome.code == 2 and "damaged" in outcome.err, outcome.err
    assert (run / "metrics.jsonl").read_bytes() == before
