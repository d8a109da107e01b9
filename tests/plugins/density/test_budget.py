"""density:budget: the exact count, along the curve, where the score is high."""

from __future__ import annotations

import pytest
import torch
from density_cases import cloud, refine, statistics, varied

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.density.budget import (
    BudgetDensity,
    BudgetDensityConfig,
    importance,
    over_median,
    shares,
)


def seen(canonical: Gaussians, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda: torch.rand(len(canonical), generator=generator)  # noqa: E731
    return statistics(draw() * 4e-4, 1 + 20 * draw(), loss=draw() + 0.1)


def run(control: BudgetDensity, canonical: Gaussians, total: int = 1000) -> list[int]:
    counts = []
    for step in range(1, total + 1):
        decision = refine(control, canonical, seen(canonical, step), step, total)
        if decision is not None:
            canonical = decision.canonical
            assert len(decision.change) == len(canonical)
            counts.append(len(canonical))
    assert torch.isfinite(canonical.log_scales).all()
    return counts


@pytest.mark.parametrize(("start", "count"), [(100, 437), (100, 101), (40, 1000), (300, 77)])
def test_the_count_is_reached_exactly_and_never_passed(start: int, count: int) -> None:
    counts = run(BudgetDensity(BudgetDensity.Config(count=count)), varied(start))
    assert counts[-1] == count
    assert max([start, *counts]) == max(start, count)


def test_the_curve_is_taming_3dgs_eq_2() -> None:
    start, budget, n = 100, 900, 8
    counts = run(
        BudgetDensity(BudgetDensity.Config(count=budget, start=0.1, stop=0.8, interval=100)),
        varied(start),
    )
    slope = 2 * (budget - start) / n
    a = (budget - start - slope * n) / n**2
    expected = [a * x**2 + slope * x + start for x in range(1, n + 1)]
    assert len(counts) == n
    assert all(abs(c - e) <= 1 for c, e in zip(counts, expected, strict=True))
    assert counts[-1] == budget


def test_the_dead_are_replaced_not_kept() -> None:
    canonical = cloud([0.01] * 20, [0.5] * 12 + [1e-3] * 8)
    decision = refine(BudgetDensity(BudgetDensity.Config(count=20)), canonical, seen(canonical))
    assert len(decision.canonical) == 20
    assert int(decision.change.source.max()) < 12
    assert torch.equal(decision.change.source[:12], torch.arange(12))
    assert decision.change.fresh.tolist() == [False] * 12 + [True] * 8


def test_all_dead_still_reach_the_count() -> None:
    canonical = cloud([0.01] * 20, torch.linspace(1e-5, 1e-3, 20))
    decision = refine(
        BudgetDensity(BudgetDensity.Config(count=20, stop=0.1)), canonical, seen(canonical)
    )
    assert len(decision.canonical) == 20


def test_all_dead_alike_still_reach_the_count() -> None:
    canonical = cloud([0.01] * 6, [1e-4] * 6)
    control = BudgetDensity(BudgetDensity.Config(count=9, stop=0.1))
    assert len(refine(control, canonical, seen(canonical)).canonical) == 9


def test_too_many_lose_the_lowest_scores() -> None:
    canonical = varied(30)
    stats = seen(canonical)
    decision = refine(BudgetDensity(BudgetDensity.Config(count=12, stop=0.1)), canonical, stats)
    best = importance(canonical, stats).topk(12).indices.sort().values
    assert torch.equal(decision.change.source, best)
    assert not decision.change.fresh.any()


def test_those_above_the_threshold_come_first_then_the_score_decides() -> None:
    canonical = cloud([0.01] * 400)
    gradients = torch.full((400,), 1e-6)
    gradients[:100] = 1e-3
    loss = torch.ones(400)
    loss[:50] = 9.0
    control = BudgetDensity(BudgetDensity.Config(count=440, stop=0.1))
    added = refine(control, canonical, statistics(gradients, loss=loss)).change.source[400:]
    assert len(added) == len(added.unique()) == 40  # without replacement
    assert int(added.max()) < 100
    assert (added < 50).float().mean() > 0.75  # 9 to 1 in score
    control = BudgetDensity(
        BudgetDensity.Config(count=600, stop=0.1)
    )  # more than are above the threshold
    added = refine(control, canonical, statistics(gradients, loss=loss)).change.source[400:]
    assert set(range(100)) < set(added.tolist())
    assert len(added.unique()) == 200


def test_large_ones_are_split_into_as_many_as_are_needed() -> None:
    canonical = cloud([0.5] * 3)
    decision = refine(
        BudgetDensity(BudgetDensity.Config(count=9, stop=0.1)), canonical, seen(canonical)
    )
    assert torch.bincount(decision.change.source).tolist() == [3, 3, 3]
    assert decision.change.fresh.all()
    torch.testing.assert_close(decision.canonical.scales, torch.full((9, 3), 0.5 / 2.4))
    assert len(decision.change.offsets.unique(dim=0)) == 9


def test_the_score_is_of_medians_and_of_what_was_seen() -> None:
    assert over_median(torch.tensor([0.0, 1.0, 2.0, 8.0])).tolist() == [0.0, 0.5, 1.0, 4.0]
    assert over_median(torch.zeros(3)).tolist() == [0.0, 0.0, 0.0]
    canonical = cloud([0.1] * 3, [0.5] * 3)
    stats = statistics([1e-4, 2e-4, 3e-4], [5.0, 5, 5], loss=[1.0, 1.0, 0.0])
    expected = [3 * (25 * 0.5 + 135), 3 * (25 + 135), 0.0]
    torch.testing.assert_close(
        importance(canonical, stats), torch.tensor(expected), rtol=1e-4, atol=0
    )
    canonical = cloud([0.1, 0.2, 0.1], [0.2, 0.4, 0.8])
    stats = statistics([2e-4, 2e-4, 2e-4], [20.0, 5, 10], loss=[1.0, 1.0, 1.0])
    # gradient 25, opacity 100, radius 10, volume 25 (Taming 3DGS, Sec. 3.2)
    expected = [3 * sum(x) for x in ((25, 50, 20, 25), (25, 100, 5, 200), (25, 200, 10, 25))]
    torch.testing.assert_close(
        importance(canonical, stats), torch.tensor(expected, dtype=torch.float32)
    )


def test_a_draw_is_in_proportion_to_the_score() -> None:
    score, alive = torch.tensor([1.0, 1.0, 8.0]), torch.tensor([True] * 3)
    generator, above = torch.Generator().manual_seed(0), torch.tensor([False] * 3)
    drawn = sum(shares(1, score, alive, above, generator) for _ in range(4000)) / 4000
    torch.testing.assert_close(drawn, score / 10, rtol=0, atol=0.02)


def test_draws_repeat_by_seed() -> None:
    make = lambda seed: BudgetDensity.from_config(  # noqa: E731
        BudgetDensityConfig(count=300), BuildContext(entity="cup", seed=seed)
    )
    canonical = varied(200)
    source = lambda seed: refine(make(seed), canonical, seen(canonical)).change.source  # noqa: E731
    assert torch.equal(source(0), source(0))
    assert not torch.equal(source(0), source(1))


def test_a_window_without_refinements_is_refused() -> None:
    canonical = varied(5)
    with pytest.raises(HoigsError, match=r"50 steps .* 100"):
        refine(
            BudgetDensity(BudgetDensity.Config(count=9)),
            canonical,
            seen(canonical),
            step=1,
            total=50,
        )
    with pytest.raises(ValueError, match="count"):
        BudgetDensityConfig()
