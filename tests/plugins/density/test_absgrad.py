"""density:absgrad: splits by absolute gradients, clones by signed ones or not."""

from __future__ import annotations

import pytest
import torch
from density_cases import cloud, refine, statistics

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.density import DensityStatistics, check_rasterizer
from hoigs.core.interfaces.rasterizer import Capabilities
from hoigs.plugins.density.adc import (
    AbsoluteGradientConfig,
    AbsoluteGradientDensity,
    AdaptiveDensity,
)
from hoigs.rasterizers.torch_tiles import TorchRasterizer

SMALL, LARGE = 0.01, 0.5


def sources(control: AdaptiveDensity, canonical, stats) -> list[int]:
    decision = refine(control, canonical, stats)
    return [] if decision.change is None else decision.change.source.tolist()


def test_large_ones_are_split_by_the_absolute_gradient() -> None:
    canonical = cloud([SMALL, SMALL, LARGE, LARGE])
    stats = statistics([1e-3, 1e-5, 1e-5, 1e-5], absolute=[1e-3, 1e-3, 1e-3, 1e-5])
    control = AbsoluteGradientDensity(AbsoluteGradientDensity.Config(keep=1))
    assert sources(control, canonical, stats) == [0, 1, 3, 0, 2, 2]  # 0 cloned, 2 split
    assert sources(AdaptiveDensity(AdaptiveDensity.Config(keep=1)), canonical, stats) == [
        0,
        1,
        2,
        3,
        0,
    ]  # 3DGS is blind to 2


def test_the_threshold_is_that_of_absgs() -> None:
    stats = statistics([0.0, 0.0], absolute=[3.9e-4, 4.1e-4])
    control = AbsoluteGradientDensity(AbsoluteGradientDensity.Config(keep=1))
    assert sources(control, cloud([LARGE, LARGE]), stats) == [0, 1, 1]


def test_clones_by_the_absolute_gradient_too() -> None:
    canonical = cloud([SMALL, SMALL, LARGE])
    stats = statistics([1e-3, 1e-5, 1e-3], absolute=[1e-3, 1e-3, 7e-4])
    config = AbsoluteGradientConfig(clone="absolute", threshold=8e-4, split_threshold=8e-4, keep=1)
    control = AbsoluteGradientDensity.from_config(config, BuildContext())
    assert sources(control, canonical, stats) == [0, 1, 2, 0, 1]


def test_the_cap_holds_at_a_threshold_far_too_low() -> None:
    canonical = cloud([LARGE] * 50)
    control = AbsoluteGradientDensity(
        AbsoluteGradientDensity.Config(cap=70, split_threshold=1e-9, threshold=1e-9)
    )
    for step in (100, 200, 300):
        stats = statistics(torch.rand(len(canonical)), absolute=torch.rand(len(canonical)) + 1)
        decision = refine(control, canonical, stats, step)
        canonical = decision.canonical if decision.canonical is not None else canonical
        assert len(canonical) <= 70
    assert len(canonical) == 70


def test_statistics_keep_both_gradients() -> None:
    stats = DensityStatistics.zeros(2)
    signed, absolute = (
        torch.tensor([[0.0, 0.0], [3.0, 4.0]]),
        torch.tensor([[6.0, 8.0], [3.0, 4.0]]),
    )
    for radii in (torch.tensor([2.0, 2.0]), torch.tensor([2.0, 0.0])):
        stats.add(signed, radii, 2, 2, absolute_gradient=absolute, loss=torch.tensor(0.5))
    assert stats.mean_gradient.tolist() == [0.0, 5.0]
    assert stats.mean_absolute_gradient.tolist() == [10.0, 5.0]
    assert stats.loss_sum.tolist() == [1.0, 0.5]


def test_a_rasterizer_without_them_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    check_rasterizer(AbsoluteGradientDensity(), TorchRasterizer)
    cannot = Capabilities(frozenset({"cpu"}), frozenset({"float32"}), True, True)
    monkeypatch.setattr(TorchRasterizer, "capabilities", cannot)
    check_rasterizer(AdaptiveDensity(), TorchRasterizer())
    with pytest.raises(RenderError, match=r"AbsoluteGradientDensity .* TorchRasterizer does not"):
        check_rasterizer(AbsoluteGradientDensity(), TorchRasterizer())
