"""A tiny run, for tests of what is seen."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

SMALL = ("model.scene.points=2000", "model.human.points=1500", "model.object.points=500")


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built-in clip at its smallest, after a few steps."""
    import hoigs

    folder = tmp_path_factory.mktemp("viewing")
    clip = folder / "clip"
    shutil.copytree(hoigs.builtin_clip(hoigs.AnnyBody(), _tiny()), clip)
    # opacities that hardly change with time, as those of a trained object: it is then rigid
    small = ["train.steps=4", "train.checkpoint_every=2", "train.rates.opacity=0.02", *SMALL]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    hoigs.train(clip, out=folder / "run", overrides=small, device="cpu", evaluate=False)
    torch.set_num_threads(threads)
    return folder / "run"


def _tiny() -> Any:
    from hoigs.synthesis import SceneConfig

    return SceneConfig.tiny()
