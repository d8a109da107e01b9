"""Models under a default dtype of torch that is not float32."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import nn

import hoigs as h
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual

MOMENT = Moment(0.5, 1)
POINTS = torch.randn(8, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(autouse=True)
def _float32_after() -> Iterator[None]:
    yield
    torch.set_default_dtype(torch.float32)


class Pushed(DeformationModel):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 3)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        return canonical.replace(means=self.layer(canonical.means))


def model(dtype: torch.dtype = torch.float32) -> h.SceneModel:
    entity = h.Entity(Gaussians.from_points(POINTS.to(dtype)), Pushed())
    return h.SceneModel({"object": entity}, rasterizer=h.TorchRasterizer())


def test_networks_of_another_dtype_are_refused_by_name() -> None:
    torch.set_default_dtype(torch.float64)
    names = r"entities\.object\.means is torch.float32 and entities\.object\.deformation\..*float64"
    with pytest.raises(HoigsError, match=rf"{names}.*set_default_dtype\(torch.float32\)"):
        model()


def test_a_default_that_changes_later_is_refused() -> None:
    made = model()
    made(MOMENT)
    torch.set_default_dtype(torch.float64)
    with pytest.raises(HoigsError, match=r"default dtype is torch.float64"):
        made(MOMENT)


def test_float64_throughout_is_none_of_both() -> None:
    torch.set_default_dtype(torch.float64)
    made = model(torch.float64)(MOMENT).joined()
    assert made.means.dtype == torch.float64
