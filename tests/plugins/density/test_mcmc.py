"""density:mcmc: relocation, growth, noise, penalties."""

from __future__ import annotations

import pytest
import torch
from density_cases import cloud, refine, varied

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.density.mcmc import McmcDensity, McmcDensityConfig, relocation_shrink


def test_dead_rows_move_to_the_living() -> None:
    canonical = varied(40)
    dead = torch.arange(40) % 5 == 0
    canonical = canonical.replace(opacity_logits=torch.where(dead, -6.0, canonical.opacity_logits))
    decision = refine(McmcDensity(McmcDensity.Config(growth=0.0)), canonical)
    change, new = decision.change, decision.canonical
    assert len(new) == 40
    assert not dead[change.source].any()
    assert torch.equal(change.source[~dead], torch.arange(40)[~dead])  # the others keep their row
    assert (change.offsets == 0).all()
    taken = torch.bincount(change.source, minlength=40)[change.source]
    assert torch.equal(change.copies, taken)
    assert torch.equal(change.fresh, taken > 1)  # sources and what joins them, nothing else
    # eq. 9, row by row
    old = canonical[change.source]
    shared = 1 - (1 - old.opacities) ** (1 / taken)
    torch.testing.assert_close(new.opacities, shared.clamp_min(0.005), rtol=1e-4, atol=1e-6)
    shrink = relocation_shrink(old.opacities, taken)
    torch.testing.assert_close(new.scales, old.scales * shrink[:, None])
    for field in ("means", "quats", "sh"):
        assert torch.equal(getattr(new, field), getattr(old, field))


def test_copies_may_stand_apart_but_sources_stay() -> None:
    canonical = varied(40)
    dead = torch.arange(40) < 10
    canonical = canonical.replace(opacity_logits=torch.where(dead, -6.0, canonical.opacity_logits))
    decision = refine(McmcDensity(McmcDensity.Config(growth=0.5, spread=0.5)), canonical)
    source, offsets = decision.change.source, decision.change.offsets
    assert (offsets[10:40] == 0).all()
    joined = torch.cat((torch.arange(10), torch.arange(40, 60)))
    assert float(offsets[joined].norm(dim=1).min()) > 0
    torch.testing.assert_close(decision.canonical.means, canonical.means[source] + offsets)
    # in standard deviations of the source: half of one, but for copies of copies
    local = (quats_to_matrices(canonical.quats[source]).mT @ offsets[..., None]).squeeze(-1)
    assert 0.3 < float((local / canonical.scales[source])[joined].square().mean().sqrt()) < 0.8


def test_relocation_prefers_the_opaque() -> None:
    opacities = torch.full((1000,), 1e-3)
    opacities[:10], opacities[10:20] = 0.1, 0.9
    decision = refine(McmcDensity(McmcDensity.Config(growth=0.0)), cloud([0.1] * 1000, opacities))
    arrivals = torch.bincount(decision.change.source, minlength=1000)[:20] - 1
    assert int(arrivals.sum()) == 980
    assert float(arrivals[10:].sum() / 980) == pytest.approx(0.9, abs=0.03)


def test_the_count_grows_by_a_fraction_to_the_cap() -> None:
    control, canonical, counts = (
        McmcDensity(McmcDensity.Config(cap=130, growth=0.05)),
        varied(100),
        [],
    )
    for step in range(100, 800, 100):
        decision = refine(control, canonical, step=step)
        canonical = decision.canonical if decision is not None else canonical
        counts.append(len(canonical))
    assert counts == [105, 110, 115, 120, 126, 130, 130]
    assert (
        refine(McmcDensity(McmcDensity.Config(cap=50)), varied(100)) is None
    )  # too many at the start stay


def test_growth_after_relocation_is_one_index_map() -> None:
    canonical = varied(60)
    canonical = canonical.replace(
        opacity_logits=torch.where(torch.arange(60) < 20, -7.0, canonical.opacity_logits)
    )
    decision = refine(McmcDensity(McmcDensity.Config(growth=0.5)), canonical)
    source, copies = decision.change.source, decision.change.copies
    assert len(source) == 90
    assert (source >= 20).all()
    # whatever the order of draws, the shares of one source's opacity make up the whole again
    clear = torch.zeros(60).index_add(0, source, torch.log1p(-decision.canonical.opacities))
    whole = torch.zeros(60).index_add(0, source, 1.0 / copies)
    torch.testing.assert_close(whole[20:], torch.ones(40))
    kept = decision.canonical.opacities > 0.0051  # the floor adds a little to the faintest
    full = torch.ones(60, dtype=torch.bool).index_put((source[~kept],), torch.tensor(False))[20:]
    torch.testing.assert_close(
        1 - clear[20:].exp()[full], canonical.opacities[20:][full], rtol=1e-4, atol=1e-5
    )


def test_all_dead_or_nothing_to_do() -> None:
    canonical = cloud([0.1] * 20, [1e-3] * 20)
    assert refine(McmcDensity(McmcDensity.Config(growth=0.0)), canonical) is None  # nowhere to go
    assert refine(McmcDensity(McmcDensity.Config(growth=0.0)), varied(20)) is None
    assert refine(McmcDensity(), varied(0)) is None


@pytest.mark.parametrize(("step", "refined"), [(0, False), (50, False), (100, True), (900, False)])
def test_window_as_fractions(step: int, refined: bool) -> None:
    control = McmcDensity.from_config(McmcDensityConfig(), BuildContext(entity="cup", seed=3))
    assert (refine(control, varied(40), step=step) is not None) == refined


def test_draws_repeat_by_seed_step_and_entity() -> None:
    make = lambda seed, name: McmcDensity.from_config(  # noqa: E731
        McmcDensityConfig(growth=0.5), BuildContext(entity=name, seed=seed)
    )
    source = lambda control, step=100: refine(control, varied(200), step=step).change.source  # noqa: E731
    first = source(make(0, "cup"))
    torch.rand(5)  # the global state has no say
    assert torch.equal(source(make(0, "cup")), first)
    for other in (source(make(1, "cup")), source(make(0, "box")), source(make(0, "cup"), 200)):
        assert not torch.equal(other, first)


def test_noise_is_shaped_by_the_covariance_and_gated_by_opacity() -> None:
    one = varied(1)
    rate, noise = 1e-3, 50.0
    for opacity, gate in ((0.005, 0.5), (0.02, 0.18242552), (0.5, 0.0)):
        many = one[torch.zeros(40_000, dtype=torch.long)].replace(
            opacity_logits=torch.full((40_000,), opacity).logit()
        )
        offsets = McmcDensity(McmcDensity.Config(noise=noise)).perturb(
            many, step=7, total_steps=100, rate=rate
        )
        covariance = one.covariances()[0]
        expected = (gate * rate * noise) ** 2 * covariance @ covariance.T
        found = offsets.T @ offsets / len(offsets)
        torch.testing.assert_close(
            found, expected, atol=0.03 * float(expected.abs().max()) + 1e-30, rtol=0
        )


def test_noise_stops_with_the_positions_and_can_be_off() -> None:
    kwargs = {"step": 5, "total_steps": 100}
    assert McmcDensity().perturb(varied(9), rate=0.0, **kwargs) is None
    assert McmcDensity(McmcDensity.Config(noise=0.0)).perturb(varied(9), rate=1.0, **kwargs) is None
    same = [McmcDensity(seed=2).perturb(varied(9), rate=1.0, **kwargs) for _ in range(2)]
    assert torch.equal(*same)
    other = McmcDensity(seed=2).perturb(varied(9), rate=1.0, step=6, total_steps=100)
    assert not torch.equal(other, same[0])


def test_penalties_are_means_of_activated_values() -> None:
    canonical = varied(30).map(lambda x: x.requires_grad_())
    found = McmcDensity(McmcDensity.Config(opacity_weight=0.3)).regularizers(canonical)
    torch.testing.assert_close(found["opacity_l1"], torch.sigmoid(canonical.opacity_logits).mean())
    torch.testing.assert_close(found["scale_l1"], canonical.log_scales.exp().mean())
    sum(found.values()).backward()
    assert float(canonical.opacity_logits.grad.min()) > 0
    assert float(canonical.log_scales.grad.min()) > 0
    assert (
        McmcDensity(McmcDensity.Config(opacity_weight=0.3)).regularizer_weights["opacity_l1"] == 0.3
    )


def test_penalties_of_one_and_of_none() -> None:
    control = McmcDensity(McmcDensity.Config())
    assert set(control.regularizers(varied(1))) == {"opacity_l1", "scale_l1"}
    assert control.regularizers(varied(1)[:0]) == {}


def keyed_entity() -> Entity:
    """Keyframes, rotations and opacities that differ from knot to knot."""
    generator = torch.Generator().manual_seed(5)
    entity = Entity(varied(12), CubicHermite(CubicHermite.Config(keyframes=4)))
    draw = lambda like: torch.randn(like.shape, generator=generator)  # noqa: E731
    with torch.no_grad():
        for name in entity.deformation.per_gaussian:
            parameter = entity.deformation.get_parameter(name)
            parameter += draw(parameter)
        entity.deformation.opacity_logits[3] = -8.0  # dead at every key
        entity.deformation.opacity_logits[7] = -8.0  # dead at all but one: alive
        entity.deformation.opacity_logits[7, 2] = 1.0
    return entity


def test_a_relocated_row_takes_the_keyframes_of_its_source() -> None:
    entity = keyed_entity()
    before = {
        name: parameter.detach().clone()
        for name, parameter in entity.deformation.named_parameters()
    }
    decision = refine(McmcDensity(McmcDensity.Config(growth=0.2)), entity.at_peak.detach())
    source, copies = decision.change.source, decision.change.copies
    assert len(source) == 14
    assert source[3] != 3
    assert source[7] == 7
    entity.apply_topology(decision.change, decision.canonical)
    for name in ("keyframe_means", "keyframe_quats", "tangents"):
        assert torch.equal(entity.deformation.get_parameter(name).data, before[name][source])
    old = torch.sigmoid(before["opacity_logits"])[source]
    shared = 1 - (1 - old) ** (1 / copies[:, None])
    torch.testing.assert_close(
        torch.sigmoid(entity.deformation.opacity_logits), shared, rtol=1e-3, atol=1e-6
    )
    alone = copies == 1
    assert torch.equal(
        entity.deformation.opacity_logits.data[alone], before["opacity_logits"][source][alone]
    )


def test_noise_turns_with_a_keyframed_object() -> None:
    entity = keyed_entity()
    before = [entity(Moment(k / 3)).detach() for k in range(4)]
    offsets = McmcDensity(McmcDensity.Config(noise=1.0)).perturb(
        entity.canonical.detach().replace(opacity_logits=torch.full((12,), -9.0)),
        step=1,
        total_steps=9,
        rate=1.0,
    )
    canonical = entity.canonical.detach().clone()
    entity.displace(offsets)
    torch.testing.assert_close(entity.means.data, canonical.means + offsets)
    for k in range(4):
        turn = quats_to_matrices(before[k].quats) @ quats_to_matrices(canonical.quats).mT
        moved = entity(Moment(k / 3)).means - before[k].means
        torch.testing.assert_close(
            moved, (turn @ offsets[..., None]).squeeze(-1), atol=1e-5, rtol=1e-4
        )
