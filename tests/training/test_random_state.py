"""The functions of hoigs leave the caller's random state as it was."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

import hoigs as h
from hoigs.core.system.random_state import callers_random_state, repeatable_convolutions
from hoigs.metrics.lpips import lpips
from hoigs.synthesis import SceneConfig, builtin_clip

FEW = ["train.steps=1", "train.preview_every=0", "model.scene.points=20"]


def numbers() -> list[float]:
    """The next number of each generator, which are left as they are."""
    with callers_random_state():
        return [random.random(), float(np.random.random()), float(torch.rand(()))]


def test_the_state_is_restored_also_after_an_error() -> None:
    before = numbers()
    with pytest.raises(KeyError), callers_random_state():
        torch.manual_seed(5)
        random.seed(5)
        np.random.seed(5)
        raise KeyError
    assert numbers() == before
    torch.rand(()), random.random(), np.random.random()
    assert all(now != then for now, then in zip(numbers(), before, strict=True))


def test_training_scoring_and_opening_a_run_leave_it_alone(tmp_path) -> None:
    folder = builtin_clip(h.AnnyBody(), SceneConfig.tiny())
    torch.manual_seed(12)
    before = numbers()
    run = tmp_path / "run"
    h.train(folder, "static", out=run, overrides=FEW, rasterizer="torch", device="cpu",
            evaluate=False)  # fmt: skip
    assert numbers() == before
    h.open_run(run, device="cpu")
    assert numbers() == before


def test_a_seed_decides_the_run_whatever_the_callers_state(tmp_path) -> None:
    folder = builtin_clip(h.AnnyBody(), SceneConfig.tiny())
    weights = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        run = h.train(folder, "static", out=tmp_path / f"run{seed}", overrides=FEW,
                      rasterizer="torch", device="cpu", evaluate=False)  # fmt: skip
        weights.append(run.session.trainer.model.entity("scene").means.detach())
    assert torch.equal(*weights)


def test_training_has_repeatable_convolutions_and_the_caller_has_what_he_set(tmp_path) -> None:
    folder = builtin_clip(h.AnnyBody(), SceneConfig.tiny())
    seen = []
    run = h.train(folder, "static", out=tmp_path / "run", overrides=FEW, rasterizer="torch",
                  device="cpu", evaluate=False,
                  on_step=lambda report: seen.append(torch.backends.cudnn.deterministic),
    )  # fmt: skip
    assert run is not None and seen == [True]
    assert not torch.backends.cudnn.deterministic


def test_the_gradient_of_lpips_repeats(device: torch.device) -> None:
    image, target = (torch.rand(96, 96, 3, device=device) for _ in range(2))
    image.requires_grad_()

    def gradient() -> torch.Tensor:
        return torch.autograd.grad(lpips(image, target), image)[0]

    with repeatable_convolutions():
        first = gradient()
        assert all(torch.equal(gradient(), first) for _ in range(10))
