"""The NaN guard names causes before effects, and gives up with a name."""

from __future__ import annotations

import pytest
import torch
from small_clip import FRAMES, small_clip
from torch import nn

from hoigs.core.errors import NotFiniteError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import LossSpec, TrainSpec
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.nan_guard import NanGuard, first_not_finite, gradients_finite
from hoigs.training.trainer import Trainer


def test_the_first_culprit_in_the_flow_is_named():
    parameters = {"entities.object.m": nn.Parameter(torch.ones(2))}
    good = Gaussians.from_points(torch.rand(4, 3))
    bad = good.replace(log_scales=torch.full((4, 3), float("nan")))
    losses = {"scene": torch.tensor(float("nan"))}
    assert first_not_finite({}, {"object": good}, parameters) is None
    assert first_not_finite(losses, {"object": good}, parameters) == "loss term 'scene'"
    named = first_not_finite(losses, {"object": bad}, parameters)
    assert named == "log_scales of the deformed Gaussians of 'object'"
    parameters["entities.object.m"].data[0] = float("inf")
    assert first_not_finite(losses, {"object": bad}, parameters) == "parameter entities.object.m"


def test_gradients_are_named_last():
    parameter = nn.Parameter(torch.ones(2))
    parameter.grad = torch.tensor([1.0, float("nan")])
    assert not gradients_finite({"p": parameter})
    assert first_not_finite({}, {}, {"p": parameter}) == "gradient of p"
    parameter.grad = torch.ones(2)
    assert gradients_finite({"p": parameter})


def test_patience_ends_with_the_name():
    guard = NanGuard(patience=3)
    guard.failed(1, "depth")
    guard.passed()
    guard.failed(2, "depth")
    guard.failed(3, "depth")
    with pytest.raises(NotFiniteError, match="depth is not finite, 3 steps in a row"):
        guard.failed(4, "depth")
    assert [step for step, _ in guard.skipped] == [1, 2, 3, 4]


class Breaks(DeformationModel):
    """A static deformation whose means are not finite at some frames."""

    input_space = "world"
    moves = False

    def __init__(self, frames: set[int]) -> None:
        super().__init__()
        self.frames = frames

    def forward(self, canonical, moment, residual=None):
        del residual
        broken = moment.index in self.frames
        return canonical.replace(means=canonical.means * torch.nan) if broken else canonical


def trainer(frames: set[int]) -> Trainer:
    clip = small_clip()
    entity = Entity(Gaussians.from_points(clip.points, scales=0.1), Breaks(frames), kind="scene")
    model = SceneModel({"scene": entity}, rasterizer=TorchRasterizer())
    loss = LossSpec(depth=0, ssim="torch")
    return Trainer(model, clip, TrainSpec(steps=18, preview_every=0, loss=loss))


def test_steps_of_a_broken_frame_are_skipped_and_a_broken_clip_stops():  # F43
    one = trainer({1})
    one.train()
    assert len(one.guard.skipped) == 18 // FRAMES
    assert {name for _, name in one.guard.skipped} == {"means of the deformed Gaussians of 'scene'"}
    assert all(torch.isfinite(p).all() for p in one.model.parameters())
    with pytest.raises(NotFiniteError, match=r"'scene'.* means"):
        trainer(set(range(FRAMES))).train()
