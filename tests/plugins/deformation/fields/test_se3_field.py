"""deformation:se3-field: rigid motion, its derivatives, the elastic loss and slices."""

from __future__ import annotations

import math

import pytest
import torch
from field_cloud import cloud, perturbed

from hoigs.core.model.entity import Entity
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.zoo.se3_field import Se3Field, Se3FieldConfig


def field(**settings) -> Se3Field:
    return Se3Field(Se3FieldConfig(**settings), times=[0.0, 1.0])


def test_se3_moves_rigidly_and_turns_what_it_moves():
    model = field(width=8, depth=1)
    entity = Entity(cloud(), model)
    with torch.no_grad():
        model.screw.weight.zero_()
        model.screw.bias.copy_(torch.tensor([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0]))
    moved = entity(Moment(0.5))
    center = (model.box.low + model.box.high) / 2
    x, y, z = (entity.means - center).unbind(-1)
    torch.testing.assert_close(moved.means - center, torch.stack((-y, x, z), -1), atol=1e-5, rtol=0)
    want = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    torch.testing.assert_close(
        moved.covariances(), want @ entity.canonical.covariances() @ want.T, atol=1e-6, rtol=0
    )
    points = torch.rand(7, 3) * 2 - 1
    torch.testing.assert_close(
        model.jacobians(points, 0.5), want.expand(7, 3, 3), atol=1e-3, rtol=0
    )
    entity.train()
    entity(Moment(0.5))
    assert float(entity.regularizers()["elastic"]) < 1e-3  # rigid: not elastic


def test_se3_derivatives_against_autograd():
    torch.manual_seed(0)
    entity = perturbed(field(width=12, depth=3), cloud(dtype=torch.float64), 0.1)
    points = torch.rand(60, 3, dtype=torch.float64) * 2 - 1
    errors = []
    for point, jacobian in zip(points, entity.deformation.jacobians(points, 0.3), strict=True):
        exact = torch.autograd.functional.jacobian(
            lambda x: entity.deformation.warp(x[None], 0.3)[0], point
        )
        errors.append(float((jacobian - exact).norm() / exact.norm()))
    errors.sort()  # a kink of a ReLU within the step makes a few of them wrong
    assert errors[30] < 2e-3 and errors[50] < 0.05


def test_stretching_is_elastic_loss():
    model = field(width=8, depth=1, frequencies=0)
    entity = Entity(cloud(), model).train()
    with torch.no_grad():  # x -> x + 0.5 relu(x) along the first axis
        model.trunk.layers[0].weight.zero_()
        model.trunk.layers[0].bias.zero_()
        model.trunk.layers[0].weight[0, 0] = 1
        model.screw.weight.zero_()
        model.screw.weight[3, 0] = 0.5
    model._sampled = (torch.tensor([[0.5, 0.0, 0.0]]), 0.5)
    squared = (math.log(1.5) / 0.03) ** 2
    expected = 2 * squared / (squared + 4)
    assert float(entity.regularizers()["elastic"]) == pytest.approx(expected, rel=1e-3)


def test_slices_change_looks_and_not_motion():
    torch.manual_seed(0)
    plain, sliced = field(width=8), field(width=8, ambient=2)
    entity = perturbed(sliced, cloud(), 0.3)
    shared = {k: v for k, v in sliced.state_dict().items() if k in plain.state_dict()}
    plain.load_state_dict(shared)
    other = Entity(cloud(), plain)
    plain.load_state_dict(shared)
    one, two = entity(Moment(0.2)), other(Moment(0.2))
    torch.testing.assert_close(one.means, two.means)
    assert (one.sh - two.sh).abs().max() > 1e-3
    assert (one.sh[:, 1:] == two.sh[:, 1:]).all()  # the constant band alone
    assert (one.opacity_logits - two.opacity_logits).abs().max() > 1e-3
    later = entity(Moment(0.9))
    assert (one.opacity_logits - later.opacity_logits).abs().max() > 1e-4


def test_a_deep_field_tells_places_and_times_apart_from_the_start():
    """As flax starts it; by PyTorch's own start all of them look alike."""
    torch.manual_seed(0)
    model = field(window_until=0)
    points = torch.rand(200, 3) * 2 - 1
    with torch.no_grad():
        here, then = (model.trunk(model._entry(points, time)) for time in (0.0, 1.0))
    spread = here.std(0).norm() / here.norm(dim=1).mean()
    change = (then - here).norm(dim=1).mean() / here.norm(dim=1).mean()
    assert spread > 0.3 and change > 0.01
