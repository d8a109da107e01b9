"""deformation:static-dynamic."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import normalize_quats, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.zoo.se3_field import Se3Field
from hoigs.plugins.deformation.zoo.static_dynamic import StaticDynamic, StaticDynamicConfig

COUNT = 14


def entity(**settings) -> Entity:
    torch.manual_seed(0)
    settings = {"width": 12, "depth": 3, "skip": 2, "elastic_points": 9} | settings
    model = StaticDynamic(StaticDynamicConfig(**settings), times=[0.0, 0.3, 1.0])
    canonical = Gaussians.from_points(torch.randn(COUNT, 3), scales=0.1)
    made = Entity(canonical.replace(quats=torch.randn(COUNT, 4)), model)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    return made


def test_shares_go_from_standing_still_to_the_field():
    made = entity()
    model, moment = made.deformation, Moment(0.7)
    field = Se3Field.forward(model, made.canonical, moment)
    model.share_logits.data[:] = torch.where(torch.arange(COUNT) < 7, -30.0, 30.0)
    out = made(moment)
    torch.testing.assert_close(out.means[:7], made.canonical.means[:7])
    still = quats_to_matrices(made.canonical.quats)[:7]
    torch.testing.assert_close(quats_to_matrices(out.quats)[:7], still)
    torch.testing.assert_close(out.means[7:], field.means[7:])
    torch.testing.assert_close(quats_to_matrices(out.quats)[7:], quats_to_matrices(field.quats)[7:])
    assert (field.means - made.canonical.means).abs().max() > 1e-3
    model.share_logits.data[:] = 0
    halfway = made(moment).means
    torch.testing.assert_close(halfway, (made.canonical.means + field.means) / 2)
    shifted = made(moment, Residual(means=torch.ones(COUNT, 3)))
    torch.testing.assert_close(shifted.means, halfway + 1)


def test_entropy_by_hand_and_its_ramp():
    model = entity(skew=2.0, entropy_from=0.01).deformation
    model.share_logits.data[:] = math.log(0.3 / 0.7)
    p = 0.3**2
    expected = -p * math.log(p) - (1 - p) * math.log(1 - p)
    assert model.entropy().item() == pytest.approx(expected, rel=1e-5)
    for progress, weight in ((0.0, 0.01), (0.5, 0.1), (1.0, 1.0)):
        model.set_progress(progress)
        found = model.regularizers()["entropy"].item()
        assert found == pytest.approx(weight * expected, rel=1e-4)


def test_entropy_sorts_and_leans_towards_still():
    """From one half, skew 1.75 pushes to the static set, no skew to neither."""
    for skew, leans in ((1.75, True), (1.0, False)):
        model = entity(skew=skew).deformation
        model.share_logits.data[:] = 0
        model.entropy().backward()
        assert (model.share_logits.grad.min() > 1e-4) == leans  # descent lowers the share


def test_gradients_reach_every_parameter():
    made = entity().train()
    total = 0
    for time in (0.0, 0.3, 1.0):
        out = made(Moment(time))
        total = total + (out.means * torch.randn(COUNT, 3)).sum()
        total = total + (out.quats * torch.randn(COUNT, 4)).sum()
    (total + sum(made.regularizers().values())).backward()
    for key, parameter in made.deformation.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, key
    torch.testing.assert_close(out.quats.norm(dim=-1), torch.ones(COUNT))
    assert normalize_quats(out.quats).isfinite().all()


def test_children_have_their_parents_share():
    made = entity()
    before = made(Moment(0.6))
    source = torch.tensor([0, 5, 5, 13])
    change = TopologyChange(source, torch.zeros(4, dtype=torch.bool), torch.zeros(4, 3))
    made.apply_topology(change, made.canonical[source])
    torch.testing.assert_close(made(Moment(0.6)).means, before.means[source])


def test_it_needs_a_clip():
    with pytest.raises(ValueError, match="StaticDynamic needs a clip"):
        StaticDynamic.from_config(StaticDynamicConfig(), BuildContext())
