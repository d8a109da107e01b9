"""Which checkpoints a training writes, keeps and removes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from hoigs.core.spec.train_schema import TrainSpec
from hoigs.runs.checkpoint import Checkpoint, complete_checkpoints
from hoigs.runs.run_folder import RunFolder
from hoigs.training import checkpointing
from hoigs.training.checkpointing import CheckpointWriter


def steps_kept(folder: Path, spec: TrainSpec, viewed: bool = False, stop_at: int = -1) -> list[int]:
    run, step = RunFolder(folder), 0
    writer = CheckpointWriter(
        run, spec, lambda: Checkpoint({"a": torch.zeros(1)}, {"step": step}), viewed
    )
    for step in range(1, spec.steps + 1):
        writer.after(step, step == stop_at)
        if step == stop_at:
            break
    files = {p.name for p in run.checkpoints.iterdir()}
    kept = complete_checkpoints(run.checkpoints)
    assert files == {f"step_{n:06d}.{e}" for n in kept for e in ("json", "safetensors")}
    return kept


@pytest.mark.parametrize(("keep", "kept"), [(None, [2, 4, 6, 7]), (2, [6, 7]), (1, [7])])
def test_the_newest_are_kept(tmp_path: Path, keep: int | None, kept: list[int]) -> None:
    spec = TrainSpec(steps=7, checkpoint_every=2, keep_checkpoints=keep)
    assert steps_kept(tmp_path, spec) == kept


def test_those_for_a_viewer_are_removed_again(tmp_path: Path, monkeypatch) -> None:
    spec = TrainSpec(steps=9, checkpoint_every=5, keep_checkpoints=None)
    monkeypatch.setattr(checkpointing, "VIEW_SECONDS", 3600.0)
    assert steps_kept(tmp_path / "one", spec, viewed=True, stop_at=4) == [4]
    monkeypatch.setattr(checkpointing, "VIEW_SECONDS", 0.0)
    monkeypatch.setattr(checkpointing, "VIEW_SHARE", 1e9)
    assert steps_kept(tmp_path / "all", spec, viewed=True) == [5, 9]
    kept = steps_kept(tmp_path / "half", spec.model_copy(update={"steps": 100}), True, stop_at=8)
    assert kept == [5, 8]
