"""deformation:chs: HOIGS's object motion."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.chs import CubicHermite, CubicHermiteConfig


def cloud(count: int = 10, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(count, 3, generator=generator, dtype=dtype)
    return Gaussians.from_points(points, torch.rand(count, 3, generator=generator), scales=0.05)


def turning_track(frames: int = 17, turn: float = 2.0, count: int = 10) -> ObjectTrack:
    s = torch.linspace(0, 1, frames)
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -1.0]), dim=0)
    return ObjectTrack(
        points=cloud(count).means,
        colors=torch.rand(count, 3),
        rotations=axis_angle_to_matrices(turn * s[:, None] * axis),
        translations=torch.stack((s.sin(), s.square(), 2 + 0 * s), -1),
        observed=torch.ones(frames, dtype=torch.bool),
    )


def perturbed(model: CubicHermite, seed: int = 0) -> CubicHermite:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator).to(parameter)
    return model


def test_equals_the_papers_formula():
    entity = Entity(cloud(), CubicHermite(CubicHermiteConfig(keyframes=4)))
    model = perturbed(entity.deformation)
    t_s = 0.45 * 3  # = 1.35
    r = t_s - 1
    m, tau = model.keyframe_means, model.tangents
    expected = (
        (2 * r**3 - 3 * r**2 + 1) * m[:, 1]
        + (r**3 - 2 * r**2 + r) * tau[:, 1]
        + (-2 * r**3 + 3 * r**2) * m[:, 2]
        + (r**3 - r**2) * tau[:, 2]
    )
    out = entity(Moment(0.45))
    torch.testing.assert_close(out.means, expected)
    logits = model.opacity_logits
    torch.testing.assert_close(out.opacity_logits, (1 - r) * logits[:, 1] + r * logits[:, 2])
    torch.testing.assert_close(out.log_scales, entity.log_scales)
    torch.testing.assert_close(out.sh, entity.sh)


@pytest.mark.parametrize("tangents", ["learned", "finite-difference"])
@pytest.mark.parametrize("opacity", ["keyed", "constant"])
def test_starts_at_rest_without_a_track(tangents, opacity):
    canonical = cloud()
    entity = Entity(
        canonical,
        CubicHermite(CubicHermiteConfig(tangents=tangents, opacity=opacity), num_frames=30),
    )
    assert entity.deformation.keyframes == 8
    for time in (0.0, 0.31, 1.0):
        out = entity(Moment(time))
        torch.testing.assert_close(out.means, canonical.means)
        torch.testing.assert_close(out.quats, canonical.quats)
        torch.testing.assert_close(out.opacity_logits, canonical.opacity_logits)
    assert entity.kind == "object"
    assert entity.opacity_logits.requires_grad == (opacity == "constant")
    assert not entity.means.requires_grad and not entity.quats.requires_grad
    assert entity.log_scales.requires_grad and entity.sh.requires_grad


def test_follows_the_track():
    track = turning_track()
    canonical = Gaussians.from_points(track.points, scales=0.05)
    model = CubicHermite.from_config(CubicHermiteConfig(), BuildContext(object_track=track))
    entity = Entity(canonical, model)
    assert model.keyframes == 5
    for frame in range(17):
        out = entity(Moment(frame / 16))
        expected = canonical.means @ track.rotations[frame].mT + track.translations[frame]
        assert (out.means - expected).norm(dim=-1).max() < 2e-3
        turned = quats_to_matrices(out.quats) - track.rotations[frame]
        assert turned.abs().max() < 1e-5  # slerp of a constant turn is exact


def test_velocity_is_the_derivative():
    entity = Entity(cloud(dtype=torch.float64), CubicHermite(CubicHermiteConfig(keyframes=5)))
    perturbed(entity.deformation)
    for time in (0.1, 0.4, 0.99):
        h = 1e-6
        numeric = (entity(Moment(time + h)).means - entity(Moment(time - h)).means) / (2 * h * 4)
        exact = entity.deformation.velocity(entity.canonical, Moment(time))
        torch.testing.assert_close(exact, numeric, atol=1e-6, rtol=1e-5)


def test_last_frame():  # F7
    for keyframes in (2, 3, 9):
        entity = Entity(cloud(), CubicHermite(CubicHermiteConfig(keyframes=keyframes)))
        model = perturbed(entity.deformation)
        torch.testing.assert_close(entity(Moment(1.0)).means, model.keyframe_means[:, -1])
        torch.testing.assert_close(entity(Moment(0.0)).means, model.keyframe_means[:, 0])
        torch.testing.assert_close(entity(Moment(1.2)).means, model.keyframe_means[:, -1])


def test_sign_of_keyframe_quats_does_not_matter():  # F4
    entity = Entity(cloud(), CubicHermite(CubicHermiteConfig(keyframes=5)))
    model = perturbed(entity.deformation)
    before = [quats_to_matrices(entity(Moment(t)).quats) for t in (0.1, 0.3, 0.6)]
    with torch.no_grad():
        model.keyframe_quats[:, ::2] *= -1
    after = [quats_to_matrices(entity(Moment(t)).quats) for t in (0.1, 0.3, 0.6)]
    for a, b in zip(before, after, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)


@pytest.mark.parametrize("tangents", ["learned", "finite-difference"])
def test_every_parameter_learns(tangents):
    entity = Entity(cloud(), CubicHermite(CubicHermiteConfig(keyframes=3, tangents=tangents)))
    model = perturbed(entity.deformation)
    weights = torch.randn(10, 4, generator=torch.Generator().manual_seed(3))
    total = torch.zeros(())
    for time in (0.2, 0.7):
        out = entity(Moment(time))
        total = total + out.means.square().sum() + (out.quats * weights).sum()
        total = total + out.opacities.sum()
    total.backward()
    for name, parameter in model.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name
        assert (parameter.grad.flatten(2 if parameter.dim() > 2 else 1).abs().sum(-1) > 0).all(), (
            name
        )


def test_gradcheck():
    canonical = cloud(2, torch.float64)
    model = CubicHermite(CubicHermiteConfig(keyframes=4))
    model.bind(canonical)
    perturbed(model)
    names = [n for n, _ in model.named_parameters()]

    def run(*parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        values = dict(zip(names, parameters, strict=True))
        out = torch.func.functional_call(model, values, (canonical, Moment(0.55)))
        return out.means, out.quats, out.opacity_logits

    assert torch.autograd.gradcheck(run, tuple(model.parameters()))


def test_finite_gradients_at_equal_and_opposite_rotations():  # F5
    for second in ([1.0, 0, 0, 0], [0, 1.0, 0, 0], [-1.0, 0, 0, 0]):
        entity = Entity(cloud(1), CubicHermite(CubicHermiteConfig(keyframes=2)))
        model = entity.deformation
        model.keyframe_quats.data = torch.tensor([[[1.0, 0, 0, 0], second]])
        out = entity(Moment(0.5))
        out.quats.sum().backward()
        assert torch.isfinite(out.quats).all()
        assert torch.isfinite(model.keyframe_quats.grad).all()


def test_large_turns_are_told():  # F5, F6
    track = turning_track(frames=5, turn=2.9)
    with pytest.warns(UserWarning, match="turns 166 degrees"):
        Entity(
            Gaussians.from_points(track.points, scales=0.1),
            CubicHermite(CubicHermiteConfig(keyframes=2), track=track),
        )


def test_rows_stay_together_and_children_turn_with_the_object():
    track = turning_track()
    entity = Entity(Gaussians.from_points(track.points, scales=0.05), CubicHermite(track=track))
    model = entity.deformation
    change = TopologyChange(
        source=torch.tensor([3, 0, 3, 7]),
        fresh=torch.tensor([False, False, True, True]),
        offsets=torch.tensor([[0.0, 0, 0], [0, 0, 0], [0.1, 0.02, -0.05], [0, 0.2, 0]]),
    )
    old = {n: p.detach().clone() for n, p in model.named_parameters()}
    canonical = entity.canonical.detach()[change.source]
    canonical = Gaussians(
        canonical.means + change.offsets,
        canonical.quats,
        canonical.log_scales,
        canonical.opacity_logits,
        canonical.sh,
    )
    entity.apply_topology(change, canonical)
    assert len(entity) == 4
    for name in ("keyframe_quats", "opacity_logits"):
        torch.testing.assert_close(model.get_parameter(name).data, old[name][change.source])
    torch.testing.assert_close(model.keyframe_means[:2], old["keyframe_means"][[3, 0]])
    for frame in (
        0,
        6,
        8,
        16,
    ):  # knots and between: each child must be where the rigid object carries it
        expected = canonical.means @ track.rotations[frame].mT + track.translations[frame]
        got = entity(Moment(frame / 16)).means
        torch.testing.assert_close(got, expected, atol=2e-3, rtol=0)


def test_regularizers_by_hand():
    model = CubicHermite(CubicHermiteConfig(keyframes=3))
    model.bind(cloud(1))
    model.keyframe_means.data = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [4, 0, 0]]])
    model.tangents.data = torch.tensor([[[1.0, 0, 0], [2, 3, 0], [3, 0, 0]]])
    penalties = model.regularizers()
    assert penalties["acceleration"].item() == pytest.approx(4.0)
    assert penalties["tangent"].item() == pytest.approx(3.0)
    assert set(penalties) >= set(model.regularizer_weights)


def test_refuses_what_it_cannot_derive():
    with pytest.raises(ValueError, match="num_frames"):
        CubicHermite()
    with pytest.raises(ValueError, match="cameras"):
        CubicHermite(CubicHermiteConfig(keyframes="adaptive"), num_frames=9)
    assert math.isclose(CubicHermite(num_frames=1).keyframes, 2)
