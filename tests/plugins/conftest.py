"""A small body on the SMPL-X tree, so that the parts of a human are tested without any asset."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hoigs.core.values.moment import BodyPose
from hoigs.testing.material import TinyBody


@pytest.fixture(scope="session")
def toy_body() -> TinyBody:
    return TinyBody()


@pytest.fixture
def toy_pose():
    def make(seed: int = 0, size: float = 0.4, dtype: torch.dtype = torch.float32) -> BodyPose:
        g = torch.Generator().manual_seed(seed)

        def draw(*shape: int) -> Tensor:
            return (size * torch.randn(*shape, generator=g)).to(dtype)

        return BodyPose(
            draw(3), draw(21, 3), draw(15, 3), draw(15, 3), draw(3), torch.zeros(2, dtype=dtype)
        )

    return make
