"""density:adc and density:none."""

from __future__ import annotations

import math

import pytest
import torch
from density_cases import cloud, refine, statistics

from hoigs.core.context import BuildContext
from hoigs.core.entity import Entity
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.density.adc import AdaptiveDensity, AdaptiveDensityConfig
from hoigs.plugins.density.none import NoDensity, NoDensityConfig


def test_clone_split_prune_by_hand():
    torch.manual_seed(0)
    rest = cloud([0.01, 0.01, 0.5, 0.5, 0.01], [0.5, 0.5, 0.5, 0.5, 0.001])
    stats = statistics([1e-3, 1e-4, 1e-3, 1e-4, 1e-3])
    decision = refine(AdaptiveDensity(keep=1), rest, stats)
    # 0 is cloned, 1 and 3 stay, 2 is split, 4 is pruned
    assert decision.change.source.tolist() == [0, 1, 3, 0, 2, 2]
    assert decision.change.fresh.tolist() == [False, False, False, True, True, True]
    assert (decision.change.offsets[:4] == 0).all()
    new = decision.rest
    torch.testing.assert_close(
        new.means, rest.means[decision.change.source] + decision.change.offsets
    )
    torch.testing.assert_close(
        new.scales[:, 0], torch.tensor([0.01, 0.01, 0.5, 0.01, 0.3125, 0.3125])
    )
    assert decision.reset_opacity is None


def test_split_children_are_drawn_from_the_parent():
    torch.manual_seed(0)
    rest = cloud([0.5] * 4000)
    flat = rest.replace(
        log_scales=torch.tensor([0.5, 0.1, 0.001]).log().expand(4000, 3),
        quats=torch.tensor([math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]).expand(4000, 4),
    )
    decision = refine(AdaptiveDensity(), flat, statistics([1e-3] * 4000))
    assert len(decision.change) == 8000
    spread = decision.change.offsets.std(0)  # turned by 90 degrees about z: x and y exchange
    torch.testing.assert_close(spread, torch.tensor([0.1, 0.5, 0.001]), rtol=0.05, atol=0)


def test_cap_takes_the_largest_gradients():  # F40
    rest = cloud([0.01] * 10)
    gradients = torch.tensor([1.0, 5, 3, 9, 2, 4, 8, 6, 7, 0.5])
    decision = refine(AdaptiveDensity(cap=13), rest, statistics(gradients))
    assert len(decision.change) == 13
    assert sorted(decision.change.source[10:].tolist()) == [3, 6, 8]
    for cap in (10, 4):
        decision = refine(AdaptiveDensity(cap=cap), rest, statistics(gradients))
        assert decision.change is None  # no room; and what is there is not thrown away


def test_count_never_exceeds_the_cap():  # F40
    torch.manual_seed(0)
    control, rest = AdaptiveDensity(cap=200, threshold=1e-6), cloud([0.3] * 20)
    for step in range(100, 500, 100):
        decision = refine(control, rest, statistics(torch.rand(len(rest))), step)
        rest = decision.rest or rest
        assert len(rest) <= 200
    assert len(rest) == 200


def test_not_everything_is_pruned():  # F42
    rest = cloud([0.01] * 50, torch.linspace(1e-5, 1e-3, 50))
    decision = refine(AdaptiveDensity(keep=8), rest, statistics([0.0] * 50))
    assert decision.change.source.tolist() == list(range(42, 50))
    decision = refine(AdaptiveDensity(keep=80), rest, statistics([0.0] * 50))
    assert decision.change is None


def test_keyed_opacity_low_at_one_moment_is_no_reason():
    rest = cloud([0.01] * 20)
    hidden = rest.replace(opacity_logits=torch.full((20,), -12.0))
    assert (
        refine(AdaptiveDensity(keep=1), rest, statistics([0.0] * 20), current=hidden).change is None
    )


def test_large_ones_can_be_pruned():
    rest = cloud([0.01, 0.9, 0.01], [0.5, 0.5, 0.5])
    stats = statistics([0.0] * 3, [1.0, 1, 50])
    assert refine(AdaptiveDensity(keep=1), rest, stats).change is None
    scale = refine(AdaptiveDensity(keep=1, prune_scale=0.1), rest, stats)
    assert scale.change.source.tolist() == [0, 2]
    radius = refine(AdaptiveDensity(keep=1, prune_radius=20), rest, stats)
    assert radius.change.source.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("step", "refined"),
    [(0, False), (50, False), (100, True), (150, False), (500, True), (600, False)],
)
def test_window(step, refined):
    control = AdaptiveDensity.from_config(AdaptiveDensityConfig(start=0.1), BuildContext())
    decision = refine(control, cloud([0.01] * 5), statistics([1.0] * 5), step)
    assert (decision is not None) == refined


def test_resets_are_refused_late():  # F41
    control = AdaptiveDensity(reset_every=50, stop=1.0, interval=1000)
    rest, stats = cloud([0.01] * 5), statistics([0.0] * 5)
    assert refine(control, rest, stats, 800).reset_opacity == 0.01
    assert refine(control, rest, stats, 800).change is None
    for step in (0, 825, 900, 950):
        assert refine(control, rest, stats, step) is None
    assert refine(AdaptiveDensity(reset_every=50), rest, stats, 550) is None  # after the window


def test_keyframed_children_follow_the_motion():
    torch.manual_seed(0)
    entity = Entity(cloud([0.5] * 6), CubicHermite(keyframes=4))
    with torch.no_grad():
        entity.deformation.keyframe_means += torch.randn_like(entity.deformation.keyframe_means)
        entity.deformation.keyframe_quats += torch.randn_like(entity.deformation.keyframe_quats)
    before = [entity(Moment(k / 3)).detach() for k in range(4)]
    stats = statistics([1.0, 0, 0, 1, 0, 0])
    decision = refine(AdaptiveDensity(), entity.rest.detach(), stats, current=before[1])
    entity.apply_topology(decision.change, decision.rest)
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
    entity = Entity(cloud([0.01] * 20), CubicHermite(keyframes=4))
    with torch.no_grad():
        entity.deformation.opacity_logits.fill_(-9.0)
        entity.deformation.opacity_logits[:15, 2] = 0.0
    decision = refine(AdaptiveDensity(keep=1), entity.at_peak.detach(), statistics([0.0] * 20))
    assert decision.change.source.tolist() == list(range(15))


def _axes(gaussians: Gaussians) -> torch.Tensor:
    from hoigs.core.rotation import quats_to_matrices

    return quats_to_matrices(gaussians.quats)


def test_none_never_refines():
    control = NoDensity.from_config(NoDensityConfig(), BuildContext())
    assert refine(control, cloud([0.5] * 4), statistics([9.0] * 4)) is None
