"""How offsets are added to Gaussians, and what the networks that make them read."""

from __future__ import annotations

import pytest
import torch
from field_cloud import ALL_HEADS, COUNT, cloud

from hoigs.core.maths.rotations import normalize_quats
from hoigs.core.values.gaussians import GaussianDelta
from hoigs.plugins.deformation.fields import DeltaHeads, TimeTable, apply_delta, positional_encoding


def test_deltas_are_added_as_their_authors_do():
    canonical = cloud()
    torch.manual_seed(0)
    delta = GaussianDelta(
        means=torch.randn(COUNT, 3),
        quats=0.3 * torch.randn(COUNT, 4),
        log_scales=0.05 * torch.rand(COUNT, 3),
    )
    raw = apply_delta(canonical, delta, turning="added")
    torch.testing.assert_close(raw.quats, canonical.quats + delta.quats)  # 4DGS: the raw quaternion
    torch.testing.assert_close(raw.log_scales, canonical.log_scales + delta.log_scales)
    active = apply_delta(canonical, delta, space="activated", turning="added")
    torch.testing.assert_close(active.quats, normalize_quats(canonical.quats) + delta.quats)
    torch.testing.assert_close(active.scales, canonical.scales + delta.log_scales)
    house = apply_delta(canonical, delta)
    torch.testing.assert_close(house.quats, canonical.moved(delta).quats)
    half = apply_delta(canonical, delta, share=0.5)
    torch.testing.assert_close(half.means, canonical.means + 0.5 * delta.means)


def test_a_scale_below_zero_stays_finite():
    canonical = cloud()
    scales = torch.full((COUNT, 3), -0.1)  # takes away exactly all of it
    out = apply_delta(canonical, GaussianDelta(log_scales=scales), space="activated")
    assert torch.isfinite(out.log_scales).all()


def test_heads_start_small_but_not_at_rest():
    heads = DeltaHeads(8, 16, 2, ALL_HEADS, bands=4)
    delta = heads(torch.randn(5, 8))
    assert delta.sh.shape == (5, 4, 3) and delta.opacity_logits.shape == (5,)
    assert delta.means.abs().max() > 0
    with pytest.raises(ValueError, match="heads must be some of"):
        DeltaHeads(8, 16, 2, ("colour",))


def test_the_window_lets_octaves_in_one_by_one():
    x = torch.rand(6, 3)
    full, none = positional_encoding(x, 4), positional_encoding(x, 4, window=0.0)
    assert torch.equal(none[:, :3], x) and not none[:, 3:].any()
    some = positional_encoding(x, 4, window=1.5)
    torch.testing.assert_close(some[:, 3:6], full[:, 3:6])  # sin of the first octave: whole
    torch.testing.assert_close(some[:, 6:9], 0.5 * full[:, 6:9])  # of the second: half
    assert not some[:, 9:15].any()
    torch.testing.assert_close(positional_encoding(x, 4, window=4.0), full)


def test_a_time_table_reads_between_its_times():
    table = TimeTable(3, [0.0, 0.2, 1.0])
    torch.testing.assert_close(table(0.2), table.codes[1])
    torch.testing.assert_close(table(0.6), 0.5 * (table.codes[1] + table.codes[2]))
    torch.testing.assert_close(table(-1.0), table.codes[0])
    torch.testing.assert_close(table(2.0), table.codes[2])
    with pytest.raises(ValueError, match="ascending"):
        TimeTable(3, [0.5, 0.1])
