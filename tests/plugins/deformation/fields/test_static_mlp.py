"""deformation:static and deformation:mlp."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.mlp import MlpConfig, MlpDeformation, positional_encoding
from hoigs.plugins.deformation.rigid_track import RigidTrack
from hoigs.plugins.deformation.static import Static


def cloud(count: int = 12, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    return Gaussians.from_points(points, scales=0.1)


def turning_track(frames: int = 9, turn: float = math.pi / 2) -> ObjectTrack:
    """Turns about z and moves along x, both at constant speed."""
    s = torch.linspace(0, 1, frames)
    zero = torch.zeros_like(s)
    return ObjectTrack(
        points=cloud().means,
        colors=torch.rand(12, 3),
        rotations=axis_angle_to_matrices(torch.stack((zero, zero, turn * s), -1)),
        translations=torch.stack((2 * s, zero, zero + 1), -1),
        observed=torch.ones(frames, dtype=torch.bool),
    )


def test_static_stays_and_follows_residual():
    canonical = cloud()
    model = Static.from_config(Static.Config(), BuildContext())
    assert model(canonical, Moment(0.3)) is canonical
    shift = torch.randn(12, 3)
    moved = model(canonical, Moment(0.3), Residual(means=shift))
    torch.testing.assert_close(moved.means, canonical.means + shift)
    assert Entity(canonical, model).kind == "scene"


def test_positional_encoding_by_hand():
    code = positional_encoding(torch.tensor([[0.5]]), 2)
    expected = [0.5, math.sin(0.5), math.sin(1.0), math.cos(0.5), math.cos(1.0)]
    assert code[0].tolist() == pytest.approx(expected, abs=1e-6)
    assert positional_encoding(torch.zeros(4, 3), 10).shape == (4, 63)


def test_mlp_is_d3dgs_by_default():
    model = MlpDeformation()
    assert len(model.trunk.layers) == 8
    assert model.trunk.layers[0].in_features == 63 + 21
    assert [layer.in_features for layer in model.trunk.layers].index(256 + 84) == 5  # after layer 4


def test_mlp_starts_at_rest_and_learns():
    torch.manual_seed(0)
    entity = Entity(cloud(), MlpDeformation(MlpConfig(width=16, depth=4)))
    moved = entity(Moment(0.7))
    torch.testing.assert_close(moved.means, entity.means)
    with torch.no_grad():
        entity.deformation.heads.weight.normal_(std=0.1)
    early, late = entity(Moment(0.1)), entity(Moment(0.9))
    assert (early.means - late.means).abs().max() > 1e-3
    assert (early.quats - late.quats).abs().max() > 1e-3
    assert (early.log_scales - late.log_scales).abs().max() > 1e-3
    (
        late.means.sum()
        + late.quats.square().sum() * 0.3
        + (late.log_scales * late.quats[:, 1:]).sum()
    ).backward()
    for name, parameter in entity.deformation.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
    # rest centres are detached at the network's input, so each gets exactly its own gradient
    torch.testing.assert_close(entity.means.grad, torch.ones(12, 3))


def test_mlp_is_held_outside_the_clip():  # F9
    torch.manual_seed(0)
    model = MlpDeformation(MlpConfig(width=16, depth=2))
    torch.nn.init.normal_(model.heads.weight)
    canonical = cloud()
    torch.testing.assert_close(
        model(canonical, Moment(1.2)).means, model(canonical, Moment(1.0)).means
    )


def test_mlp_gradcheck():
    torch.manual_seed(0)
    model = MlpDeformation(
        MlpConfig(width=8, depth=3, position_frequencies=2, time_frequencies=2)
    ).double()
    torch.nn.init.normal_(model.heads.weight, std=0.3)
    canonical = cloud(3, dtype=torch.float64)

    def run(*parameters: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = torch.func.functional_call(
            model, dict(zip(names, parameters, strict=True)), (canonical, Moment(0.4))
        )
        return out.means, out.quats, out.log_scales

    names = [n for n, _ in model.named_parameters()]
    assert torch.autograd.gradcheck(run, tuple(model.parameters()), fast_mode=True)


def test_mlp_rides_on_the_track():
    track = turning_track()
    context = BuildContext(object_track=track)
    model = MlpDeformation.from_config(MlpConfig(width=16, depth=2), context)
    canonical = cloud()
    for frame in (0, 3, 8):
        moved = model(canonical, Moment(frame / 8))
        expected = canonical.means @ track.rotations[frame].mT + track.translations[frame]
        torch.testing.assert_close(moved.means, expected, atol=1e-5, rtol=1e-5)
    free = MlpDeformation.from_config(MlpConfig(width=16, depth=2, track=False), context)
    torch.testing.assert_close(free(canonical, Moment(1.0)).means, canonical.means)


def test_track_between_frames_and_of_one_frame():
    track = RigidTrack(turning_track(frames=3))
    quat, translation = track.at(0.25)
    half = math.pi / 2 * 0.25 / 2
    torch.testing.assert_close(quat, torch.tensor([math.cos(half), 0, 0, math.sin(half)]))
    torch.testing.assert_close(translation, torch.tensor([0.5, 0.0, 1.0]))
    assert track.largest_step(3) == pytest.approx(math.pi / 4, abs=1e-3)
    still = RigidTrack(turning_track(frames=1))
    torch.testing.assert_close(still.at(0.8)[1], torch.tensor([0.0, 0.0, 1.0]))
