"""The NaN guard names causes before effects, and gives up with a name."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from hoigs.core.errors import NotFiniteError
from hoigs.core.values.gaussians import Gaussians
from hoigs.training.nan_guard import NanGuard, first_not_finite, gradients_finite


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
