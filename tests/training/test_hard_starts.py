"""Composed specs trained from what breaks published code: each where it fails, by its number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from hoigs.core.model.entity import FIELDS
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.studies.stress.capabilities import capabilities, compose_small, rate_of, tiny_clip
from hoigs.training.trainer import Trainer

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True, scope="module")
def own_weights() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_LPIPS_WEIGHTS", "none.npz")
        yield


def trainer_of(clip: Clip, source: str = "hoigs") -> Trainer:
    spec, model, density = compose_small(source, clip=clip)
    return Trainer(model, clip, spec.train, density=density)


def at(clip: Clip, time: float) -> Moment:
    """A moment at any time, with the body poses of the nearest frame."""
    last = len(clip) - 1
    return replace(clip.moments[min(max(round(time * last), 0), last)], time=time)


def require_sane(trainer: Trainer) -> None:
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())
    assert not trainer.guard.skipped


def test_a_test_frame_before_the_first_training_frame():  # F08
    clip = tiny_clip()
    clip = replace(clip, split={"train": list(range(1, len(clip))), "test": [0]})
    trainer = trainer_of(clip)
    trainer.train()
    with torch.no_grad():
        means = [trainer.model(moment).joined().means for moment in clip.moments]
    ways = [(b - a).norm(dim=-1) for a, b in pairwise(means)]
    steps = [float(way[way > 1e-9].mean()) for way in ways]
    assert all(torch.isfinite(m).all() for m in means)
    assert steps[0] <= 2 * sorted(steps[1:])[len(steps) // 2] + 1e-3


def test_a_camera_that_stands_still():  # F13, F14
    trainer = trainer_of(tiny_clip("camera.path=static"))
    trainer.train()
    require_sane(trainer)
    moved = [n for n in trainer.model.entities if trainer.model.entity(n).means.requires_grad]
    assert moved and all(trainer.optimizer.position_rate(name) > 0 for name in moved)


def test_first_splats_a_hundred_times_too_large():  # F29
    trainer = trainer_of(tiny_clip())
    with torch.no_grad():
        for name in trainer.model.entities:
            trainer.model.entity(name).log_scales.add_(torch.log(torch.tensor(100.0)))
    trainer.train()
    require_sane(trainer)


@pytest.mark.parametrize("full", [False, True])
def test_masks_that_are_all_empty_or_all_full(full: bool):  # F48
    trainer = trainer_of(tiny_clip())
    frame = trainer.clip[trainer.clip.split["train"][2]]
    masks = {name: torch.full_like(mask, full) for name, mask in frame.masks.items()}
    found = trainer.objective(replace(frame, masks=masks), frame.camera, torch.Generator())
    own = [term for term in found.terms if term.partition("/")[0] in ("human", "object")]
    assert bool(own) == full
    found.total.backward()
    assert torch.isfinite(found.total)
    assert all(p.grad is None or p.grad.isfinite().all() for p in trainer.model.parameters())


def shaken(model: SceneModel) -> SceneModel:
    """With noise on all but the canonical Gaussians, so that heads that start at zero learn."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.rpartition(".")[2] not in FIELDS or ".deformation." in name:
                parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return model


def test_every_row_of_a_time_plane_is_read():  # F10
    """4DGS' published code reads half of its time axis."""
    clip = tiny_clip()
    _, model, density = compose_small("hoigs", clip=clip)
    assert "time planes" in capabilities(model, density)
    planes = {
        path: parameter
        for name in shaken(model).entities
        for path, parameter in model.entity(name).deformation.named_parameters()
        if rate_of(path, model.entity(name).deformation.rates) == "planes" and "time" in path
    }
    read = {path: torch.zeros(p.shape[1], dtype=torch.bool) for path, p in planes.items()}
    rows = max(p.shape[1] for p in planes.values())
    for time in torch.linspace(0, 1, 2 * rows + 1).tolist():
        model.zero_grad(set_to_none=True)
        state = model(at(clip, time)).joined()
        sum(value.sin().sum() for value in state.tensors().values()).backward()
        for path, parameter in planes.items():
            if parameter.grad is not None:
                read[path] |= parameter.grad.abs().sum((0, 2, 3)) > 0
    assert read and all(rows.all() for rows in read.values())


@pytest.mark.parametrize(("source", "decays"), [("hoigs-paper", True), ("ex4dgs", False)])
def test_the_rate_of_keyframes_decays(source: str, decays: bool):  # F54
    """Ex4DGS' published code has a schedule that never runs."""
    optimizer = trainer_of(tiny_clip(), source).optimizer
    rates = [
        (schedule.at(0.3), schedule.at(1.0))
        for role, schedule in zip(optimizer.roles, optimizer.schedules, strict=True)
        if role == "keyframes"
    ]
    assert rates and all((late < early) == decays for early, late in rates)
