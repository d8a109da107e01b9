"""deformation:hexplane-field and deformation:mlp where 4DGS and D3DGS have ways of their own."""

from __future__ import annotations

import pytest
import torch
from field_cloud import cloud, perturbed

from hoigs.core.model.entity import Entity
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.mlp import MlpConfig, MlpDeformation
from hoigs.plugins.deformation.zoo.hexplane_field import HexPlaneField, HexPlaneFieldConfig


def planes(**settings) -> HexPlaneField:
    small = {"channels": 4, "resolution": 6, "time_resolution": 5, "multires": (1,), "width": 12}
    return HexPlaneField(HexPlaneFieldConfig(**(small | settings)))


def mlp(**settings) -> MlpDeformation:
    return MlpDeformation(MlpConfig(width=12, depth=4, **settings))


def test_4dgs_reads_half_of_its_time_planes():
    """Its time is in [0, 1] where the planes span [-1, 1]."""

    def rows(span: str) -> list[int]:
        model = planes(
            channels=2, resolution=4, time_resolution=9, width=8, heads=("means",), time_span=span
        )
        entity = Entity(cloud(), model)
        for time in torch.linspace(0, 1, 21).tolist():
            entity(Moment(time)).means.square().sum().backward()
        grads = model.planes.time[0].grad.abs().amax((0, 2, 3))
        return (grads > 0).nonzero().flatten().tolist()

    assert rows("half") == [4, 5, 6, 7, 8] and rows("whole") == list(range(9))


def test_4dgs_lets_gradients_through_its_lookup_and_d3dgs_does_not():
    for model, through in (
        (planes(), True),
        (mlp(position_frequencies=3, time_frequencies=3), False),
    ):
        entity = perturbed(model, cloud())
        out = entity(Moment(0.4))
        (out.means - entity.means).square().sum().backward()
        reached = entity.means.grad is not None and bool(entity.means.grad.abs().max() > 1e-6)
        assert reached is through


def test_the_static_stage():
    for model in (planes(start=0.2), mlp(start=0.2, zero_heads=False)):
        entity = perturbed(model, cloud())
        assert not torch.equal(entity(Moment(0.5)).means, entity.means)  # a finished model moves
        model.set_progress(0.19)
        assert torch.equal(entity(Moment(0.5)).means, entity.means)
        assert entity.regularizers() == {}
        model.set_progress(0.2)
        assert not torch.equal(entity(Moment(0.5)).means, entity.means)


def test_time_noise_fades_and_is_of_training_alone():
    config = MlpConfig(width=12, depth=4, zero_heads=False, time_noise=2.0, noise_until=0.5)
    model = MlpDeformation(config, num_frames=10)
    entity = perturbed(model, cloud())
    model.set_progress(0.0)
    assert model.noise_now() == pytest.approx(0.2)
    entity.train()
    one, two = entity(Moment(0.5)).means, entity(Moment(0.5)).means
    assert not torch.equal(one, two)
    with torch.no_grad():  # previews
        assert torch.equal(entity(Moment(0.5)).means, entity(Moment(0.5)).means)
    model.set_progress(0.25)
    assert model.noise_now() == pytest.approx(0.1)
    model.set_progress(0.5)
    assert torch.equal(entity(Moment(0.5)).means, entity(Moment(0.5)).means)
    with pytest.raises(ValueError, match="num_frames"):
        MlpDeformation(MlpConfig(time_noise=0.1))


def test_plane_penalties_are_4dgs_formula():
    torch.manual_seed(0)
    model = planes(channels=2, resolution=5, time_resolution=6, multires=(1, 2), width=8)
    expected = dict.fromkeys(("plane_tv", "time_smoothness", "l1_time_planes"), 0.0)
    with torch.no_grad():
        for space, time in zip(model.planes.space, model.planes.time, strict=True):
            time += torch.randn_like(time)
            for plane in space:
                second = plane[2:] - 2 * plane[1:-1] + plane[:-2]
                expected["plane_tv"] += float(second.square().mean())
            for plane in time:
                second = plane[2:] - 2 * plane[1:-1] + plane[:-2]
                expected["time_smoothness"] += float(second.square().mean())
                expected["l1_time_planes"] += float((plane - 1).abs().mean())
    found = {name: value.item() for name, value in model.regularizers().items()}
    assert found == pytest.approx(expected, rel=1e-4)
