"""A training that is killed goes on: nothing that was half written is read."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_clip import small_clip

from hoigs.core.clip_folder.write import write_clip
from hoigs.runs.run_folder import RunFolder
from hoigs.training.session import Session

ROOT = Path(__file__).parents[2]
SETTINGS = ["train.steps=12", "train.checkpoint_every=4", "train.log_every=1",
            "model.scene.points=500"]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clips") / "small"
    clip = small_clip()
    clip.split["test"].append(clip.split["train"].pop())
    write_clip(clip, path)
    return path


def opened(folder: Path, out: Path, **more: bool) -> Session:
    overrides = [*SETTINGS, "train.preview_every=0"]
    return Session.open(folder, "static", out=out, overrides=overrides, **more)


def test_a_run_killed_before_its_first_checkpoint_starts_again(
    folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    started = opened(folder, out)  # the folder is there, nothing is trained
    started.run.log({"step": 1, "loss": 0.3})
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"step": 2, "lo')
    (out / "checkpoints" / "step_000004.safetensors.part").write_bytes(b"half")
    (out / "checkpoints" / "step_000004.safetensors").write_bytes(b"its .json never came")
    started.run.unlock()
    again = opened(folder, out, resume=True)
    assert again.trainer.step == 0
    again.train()
    steps = [json.loads(x)["step"] for x in (out / "metrics.jsonl").read_text().splitlines()]
    assert steps == list(range(1, 13))


def test_a_line_without_its_end_is_cut(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.metrics.write_text('{"step": 1}\n{"step": 5}\n{"step": 9}\n{"ste')
    run.cut_metrics(5)
    assert run.metrics.read_text() == '{"step": 1}\n{"step": 5}\n'


def test_what_a_dead_process_left_is_removed_and_a_living_one_kept(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    gone = tmp_path / f".run.{dead.pid}.part"
    kept = [tmp_path / f".run.{os.getppid()}.part", tmp_path / f".other.{dead.pid}.part"]
    for path in (gone, *kept):
        path.mkdir()
    RunFolder(tmp_path / "run").create("name: x\n", {})
    assert not gone.exists()
    assert all(path.exists() for path in kept)


@pytest.mark.slow
def test_killed_while_it_writes_it_ends_as_the_unbroken_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.kill_train import hammer

    command = [sys.executable, "-c", "from hoigs.cli.main import main; main()", "train"]
    command += [str(folder), "--spec", "static", "--device", "cpu", "--no-eval"]
    for setting in ("train.steps=10", "train.checkpoint_every=1", "train.preview_every=0",
                    "model.scene.points=500"):  # fmt: skip
        command += ["--set", setting]
    started = time.perf_counter()
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    whole = tmp_path / "whole"
    subprocess.run([*command, "--out", str(whole)], check=True, env=environment)
    duration = time.perf_counter() - started
    run = tmp_path / "run"
    command += ["--out", str(run)]
    record = hammer(command, run, whole, kills=1, duration=0.8 * duration, seed=3)
    assert record.faults == []
    assert record.kills == 1 and record.finished >= 1
