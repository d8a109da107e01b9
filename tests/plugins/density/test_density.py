"""density:adc and density:none."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from density_cases import EXTENT, cloud, refine, statistics

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.density.adc import AdaptiveDensity, AdaptiveDensityConfig
from hoigs.plugins.density.none import NoDensity


def adaptive_density(**settings: Any) -> AdaptiveDensity:
    return AdaptiveDensity(AdaptiveDensity.Config(**settings))


def test_clone_split_prune_by_hand():
    torch.manual_seed(0)
    canonical = cloud([0.01, 0.01, 0.5, 0.5, 0.01], [0.5, 0.5, 0.5, 0.5, 0.001])
    stats = statistics([1e-3, 1e-4, 1e-3, 1e-4, 1e-3])
    decision = refine(adaptive_density(keep=1), canonical, stats)
    # 0 is cloned, 1 and 3 stay, 2 is split, 4 is pruned
    assert decision.change.source.tolist() == [0, 1, 3, 0, 2, 2]
    assert decision.change.fresh.tolist() == [False, False, False, True, True, True]
    assert (decision.change.offsets[:4] == 0).all()
    new = decision.canonical
    torch.testing.assert_close(
        new.means, canonical.means[decision.change.source] + decision.change.offsets
    )
    torch.testing.assert_close(
        new.scales[:, 0], torch.tensor([0.01, 0.01, 0.5, 0.01, 0.3125, 0.3125])
    )
    assert decision.reset_opacity is None


def test_thresholds_are_those_of_3dgs():
    """Gradient 2e-4, scale 1 % of the extent, opacity 0.005; each Gaussian is just on one side."""
    small, large = 0.0099 * EXTENT, 0.0101 * EXTENT
    canonical = cloud([small, large, small, large, small, small], [0.5] * 4 + [0.0049, 0.0051])
    stats = statistics([2.1e-4, 2.1e-4, 1.9e-4, 1.9e-4, 2.1e-4, 0.0])
    decision = refine(adaptive_density(keep=1), canonical, stats)
    # 0 is cloned, 1 is split, 4 is pruned
    assert decision.change.source.tolist() == [0, 2, 3, 5, 0, 1, 1]


def test_split_children_are_drawn_from_the_parent():
    torch.manual_seed(0)
    canonical = cloud([0.5] * 4000)
    flat = canonical.replace(
        log_scales=torch.tensor([0.5, 0.1, 0.001]).log().expand(4000, 3),
        quats=torch.tensor([math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]).expand(4000, 4),
    )
    decision = refine(AdaptiveDensity(), flat, statistics([1e-3] * 4000))
    assert len(decision.change) == 8000
    spread = decision.change.offsets.std(0)  # turned by 90 degrees about z: x and y exchange
    torch.testing.assert_close(spread, torch.tensor([0.1, 0.5, 0.001]), rtol=0.05, atol=0)


def test_cap_takes_the_largest_gradients():
    canonical = cloud([0.01] * 10)
    gradients = torch.tensor([1.0, 5, 3, 9, 2, 4, 8, 6, 7, 0.5])
    decision = refine(adaptive_density(cap=13), canonical, statistics(gradients))
    assert len(decision.change) == 13
    assert sorted(decision.change.source[10:].tolist()) == [3, 6, 8]
    for cap in (10, 4):
        decision = refine(adaptive_density(cap=cap), canonical, statistics(gradients))
        assert decision.change is None  # no room; and what is there is not thrown away


def test_count_never_exceeds_the_cap():
    torch.manual_seed(0)
    control, canonical = (adaptive_density(cap=200, threshold=1e-6), cloud([0.3] * 20))
    for step in range(100, 500, 100):
        decision = refine(control, canonical, statistics(torch.rand(len(canonical))), step)
        canonical = decision.canonical or canonical
        assert len(canonical) <= 200
    assert len(canonical) == 200


def test_not_everything_is_pruned():
    canonical = cloud([0.01] * 50, torch.linspace(1e-5, 1e-3, 50))
    decision = refine(adaptive_density(keep=8), canonical, statistics([0.0] * 50))
    assert decision.change.source.tolist() == list(range(42, 50))
    decision = refine(adaptive_density(keep=80), canonical, statistics([0.0] * 50))
    assert decision.change is None


def test_keyed_opacity_low_at_one_moment_is_no_reason():
    canonical = cloud([0.01] * 20)
    hidden = canonical.replace(opacity_logits=torch.full((20,), -12.0))
    assert (
        refine(adaptive_density(keep=1), canonical, statistics([0.0] * 20), current=hidden).change
        is None
    )


def test_large_ones_can_be_pruned():
    canonical = cloud([0.01, 0.9, 0.01], [0.5, 0.5, 0.5])
    stats = statistics([0.0] * 3, [1.0, 1, 50])
    assert refine(adaptive_density(keep=1), canonical, stats).change is None
    scale = refine(adaptive_density(keep=1, prune_scale=0.1), canonical, stats)
    assert scale.change.source.tolist() == [0, 2]
    radius = refine(adaptive_density(keep=1, prune_radius=20), canonical, stats)
    assert radius.change.source.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("step", "refined"),
    [(0, False), (50, False), (100, True), (150, False), (500, True), (600, False)],
)
def test_window(step, refined):
    control = AdaptiveDensity.from_config(AdaptiveDensityConfig(start=0.1), BuildContext())
    decision = refine(control, cloud([0.01] * 5), statistics([1.0] * 5), step)
    assert (decision is not None) == refined


def test_resets_are_refused_late():
    control = adaptive_density(reset_every=50, stop=1.0, interval=1000)
    canonical, stats = cloud([0.01] * 5), statistics([0.0] * 5)
    assert refine(control, canonical, stats, 800).reset_opacity == 0.01
    assert refine(control, canonical, stats, 800).change is None
    for step in (0, 825, 900, 950):
        assert refine(control, canonical, stats, step) is None
    assert (
        refine(adaptive_density(reset_every=50), canonical, stats, 550) is None
    )  # after the window


def test_keyframed_children_follow_the_motion():
    torch.manual_seed(0)
    entity = Entity(cloud([0.5] * 6), CubicHermite(CubicHermite.Config(keyframes=4)))
    with torch.no_grad():
        entity.deformation.keyframe_means += torch.randn_like(entity.deformation.keyframe_means)
        entity.deformation.keyframe_quats += torch.randn_like(entity.deformation.keyframe_quats)
    before = [entity(Moment(k / 3)).detach() for k in range(4)]
    stats = statistics([1.0, 0, 0, 1, 0, 0])
    decision = refine(AdaptiveDensity(), entity.canonical.detach(), stats, current=before[1])
    entity.apply_topology(decision.change, decision.canonical)
    source = decision.change.source
    assert len(entity) == 8
    for k in range(4):
        after = entity(Moment(k / 3))
        torch.testing.assert_close(after.quats, before[k].quats[source])
        # in the parent's own axes each child stands in the same place at every keyframe
        local = torch.linalg.solve(
            _axes(before[k])[source], (after.means - before[k].means[source])[..., None]
        )
        torch.testing.assert_close(local.squeeze(-1), decision.change.offsets, atol=1e-5, rtol=1e-4)


def test_keyed_opacities_are_judged_at_their_largest():
    entity = Entity(cloud([0.01] * 20), CubicHermite(CubicHermite.Config(keyframes=4)))
    with torch.no_grad():
        entity.deformation.opacity_logits.fill_(-9.0)
        entity.deformation.opacity_logits[:15, 2] = 0.0
    decision = refine(adaptive_density(keep=1), entity.at_peak.detach(), statistics([0.0] * 20))
    assert decision.change.source.tolist() == list(range(15))


def _axes(gaussians: Gaussians) -> torch.Tensor:
    from hoigs.core.maths.rotations import quats_to_matrices

    return quats_to_matrices(gaussians.quats)


def test_none_never_refines():
    control = NoDensity.from_config(NoDensity.Config(), BuildContext())
    assert refine(control, cloud([0.5] * 4), statistics([9.0] * 4)) is None
