"""Kernels without second derivatives refuse them by name, however they are asked for."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hoigs.core.device import replacement
from hoigs.core.errors import DerivativeError
from hoigs.core.maths.feature_planes import sample_planes
from hoigs.core.maths.nearest import point_roughness
from hoigs.core.maths.skinning import skin_gaussians
from hoigs.metrics.kernels.image_loss import Target, image_losses


def planes(x: Tensor) -> Tensor:
    return sample_planes(torch.arange(32.0).view(1, 4, 4, 2), x.tanh()[None, :, :2])


def skin(x: Tensor) -> Tensor:
    quats = torch.cat((torch.ones(len(x), 1), x), 1)
    transforms, weights = torch.eye(4).repeat(2, 1, 1), torch.full((len(x), 2), 0.5)
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)
    return torch.cat(skin_gaussians(x, quats, weights, transforms, turns), 1)


def roughness(x: Tensor) -> Tensor:
    neighbours = torch.tensor([[1], [0], [0], [1]])
    assert replacement(point_roughness, x, neighbours) is not None
    return point_roughness(x, neighbours)


def photometric(x: Tensor) -> Tensor:
    return image_losses(x[None], [Target(torch.zeros(1, 4, 3, dtype=torch.uint8), 1.0, 0.2)])


@pytest.mark.parametrize("function", [planes, skin, roughness, photometric])
def test_a_penalty_of_gradients_is_refused(function: Callable[[Tensor], Tensor]) -> None:
    torch.manual_seed(0)
    x = torch.rand(4, 3, requires_grad=True)
    # the upstream gradient needs no gradient here, where once_differentiable is silent
    (slope,) = torch.autograd.grad(function(x).sum(), x, create_graph=True)
    (plain,) = torch.autograd.grad(function(x).sum(), x)
    assert torch.equal(slope, plain)
    with pytest.raises(DerivativeError, match="create_graph"):
        slope.square().sum().backward()
