"""What every deformation of the whole scene owes: deformation:hexplane-field, embedded, se3-field
and mlp in D3DGS's own way."""

from __future__ import annotations

import math

import pytest
import torch

from hoigs.core.clip import Clip
from hoigs.core.context import BuildContext
from hoigs.core.entity import Entity
from hoigs.core.gaussians import GaussianDelta, Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import normalize_quats
from hoigs.core.topology import TopologyChange
from hoigs.plugins.deformation.deltas import DeltaHeads, apply_delta
from hoigs.plugins.deformation.embedded import Embedded
from hoigs.plugins.deformation.encoding import TimeTable, positional_encoding
from hoigs.plugins.deformation.hexplane_field import HexPlaneField, HexPlaneFieldConfig
from hoigs.plugins.deformation.mlp import MlpDeformation
from hoigs.plugins.deformation.se3_field import Se3Field, Se3FieldConfig

COUNT = 14
ALL_HEADS = ("means", "scales", "rotations", "opacity", "sh")
MAKE = {
    "hexplane-field": lambda: HexPlaneField(4, 6, 5, (1, 2), 12, 2, ALL_HEADS),
    "hexplane-4dgs": lambda: HexPlaneField(
        4, 6, 9, (1, 2), 12, 1, time_span="half", turning="added"
    ),
    "embedded": lambda: Embedded(5, 8, 9, 3, width=12, depth=2, heads=ALL_HEADS, neighbours=4),
    "embedded-own": lambda: Embedded(
        5, 8, 9, 3, width=12, turning="added", table_smoothness="last-row", neighbours=4
    ),
    "se3-field": lambda: Se3Field([0.0, 0.3, 1.0], width=12, depth=3, skip=2, elastic_points=9),
    "se3-ambient": lambda: Se3Field(
        [0.0, 0.3, 1.0], width=12, depth=3, skip=2, ambient=2, ambient_depth=2, ambient_width=8
    ),
    "mlp-d3dgs": lambda: MlpDeformation(
        12, 4, 3, 3, space="activated", turning="added", zero_heads=False
    ),
}


def cloud(count: int = COUNT, dtype: torch.dtype = torch.float32) -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(count, 3, generator=generator, dtype=dtype)
    colors = torch.rand(count, 3, generator=generator, dtype=dtype)
    rest = Gaussians.from_points(points, colors, scales=0.1, sh_degree=1)
    quats = torch.randn(count, 4, generator=generator, dtype=dtype)
    return rest.replace(quats=quats)


def perturbed(model, rest: Gaussians, size: float = 0.2) -> Entity:
    """An entity whose every parameter is off its start, heads that start at zero too."""
    torch.manual_seed(1)
    entity = Entity(rest, model).to(rest.means)
    with torch.no_grad():
        for parameter in entity.deformation.parameters():
            parameter += size * torch.randn_like(parameter)
    return entity


@pytest.fixture(params=MAKE)
def entity(request) -> Entity:
    torch.manual_seed(0)
    return perturbed(MAKE[request.param](), cloud())


def test_it_moves_with_time(entity):
    early, late = entity(Moment(0.1)), entity(Moment(0.8))
    assert (early.means - late.means).abs().max() > 1e-4
    assert (early.quats - late.quats).abs().max() > 1e-4
    assert entity.deformation.rest_space == "world"


def test_gradients_reach_every_parameter(entity):
    entity.train()
    torch.manual_seed(0)
    loss = torch.zeros(())
    for time in (0.05, 0.2, 0.35, 0.6, 0.95):  # rows and codes of all times
        out = entity(Moment(time))
        for i, field in enumerate((out.means, out.quats, out.log_scales, out.sh)):
            loss = loss + (field * torch.linspace(0.2, 1.0 + i, field.numel()).view_as(field)).sum()
        loss = loss + (out.opacity_logits * torch.linspace(-1, 2, COUNT)).sum()
    loss = loss + sum(entity.regularizers().values())
    loss.backward()
    for name, parameter in entity.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_order_does_not_matter(entity):
    order = torch.randperm(COUNT, generator=torch.Generator().manual_seed(5))
    before = entity(Moment(0.4)).detach().clone()
    still = TopologyChange(order, torch.zeros(COUNT, dtype=torch.bool), torch.zeros(COUNT, 3))
    entity.apply_topology(still, entity.rest[order])
    after = entity(Moment(0.4))
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        torch.testing.assert_close(
            getattr(after, name), getattr(before, name)[order], rtol=1e-4, atol=1e-5
        )


def test_one_gaussian_moves_as_among_many(entity):
    """Nothing but its own row decides what a Gaussian does."""
    whole = entity(Moment(0.4)).detach().clone()
    entity.apply_topology(
        TopologyChange.keep(torch.arange(COUNT) == 3), entity.rest[torch.tensor([3])]
    )
    alone = entity(Moment(0.4))
    torch.testing.assert_close(alone.means[0], whole.means[3], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(alone.quats[0], whole.quats[3], rtol=1e-4, atol=1e-5)


def test_times_outside_are_held(entity):  # F9
    for outside, end in ((-0.3, 0.0), (1.7, 1.0)):
        out, at_end = entity(Moment(outside)), entity(Moment(end))
        torch.testing.assert_close(out.means, at_end.means)
        assert all(torch.isfinite(value).all() for value in vars(out).values())


def test_residuals_displace(entity):
    shift = torch.randn(COUNT, 3)
    moved = entity.deformation(entity.rest, Moment(0.4), Residual(means=shift))
    torch.testing.assert_close(moved.means, entity(Moment(0.4)).means + shift)


def test_it_survives_growth_and_a_state_dict(entity):
    source = torch.tensor([0, 0, 5, 7, 7, 7])
    fresh = torch.tensor([False, True, False, False, True, True])
    change = TopologyChange(source, fresh, torch.zeros(6, 3))
    before = entity(Moment(0.3)).means[source]
    entity.apply_topology(change, entity.rest[source])
    torch.testing.assert_close(entity(Moment(0.3)).means, before, rtol=1e-4, atol=1e-5)
    entity.train()
    entity(Moment(0.3))
    assert all(torch.isfinite(value) for value in entity.regularizers().values())
    other = Entity(cloud(6), type_of(entity))
    other.load_state_dict(entity.state_dict())
    torch.testing.assert_close(other(Moment(0.3)).means, entity(Moment(0.3)).means)


def type_of(entity: Entity):
    """A fresh deformation of the same make."""
    for make in MAKE.values():
        model = make()
        probe = Entity(cloud(len(entity)), model)
        shapes = {k: v.shape for k, v in probe.state_dict().items()}
        if shapes == {k: v.shape for k, v in entity.state_dict().items()}:
            return make_like(model, entity.deformation)
    raise AssertionError("no maker fits")


def make_like(model, like):
    for name in ("time_span", "turning", "space"):
        if hasattr(like, name):
            setattr(model, name, getattr(like, name))
    return model


# apply_delta ------------------------------------------------------------------------------------


def test_deltas_are_added_as_their_authors_do():
    rest = cloud()
    torch.manual_seed(0)
    delta = GaussianDelta(
        means=torch.randn(COUNT, 3),
        quats=0.3 * torch.randn(COUNT, 4),
        log_scales=0.05 * torch.rand(COUNT, 3),
    )
    raw = apply_delta(rest, delta, turning="added")
    torch.testing.assert_close(raw.quats, rest.quats + delta.quats)  # 4DGS: the raw quaternion
    torch.testing.assert_close(raw.log_scales, rest.log_scales + delta.log_scales)
    active = apply_delta(rest, delta, space="activated", turning="added")
    torch.testing.assert_close(active.quats, normalize_quats(rest.quats) + delta.quats)
    torch.testing.assert_close(active.scales, rest.scales + delta.log_scales)
    house = apply_delta(rest, delta)
    torch.testing.assert_close(house.quats, rest.moved(delta).quats)
    half = apply_delta(rest, delta, share=0.5)
    torch.testing.assert_close(half.means, rest.means + 0.5 * delta.means)


def test_a_scale_below_zero_stays_finite():
    rest = cloud()
    scales = torch.full((COUNT, 3), -0.1)  # takes away exactly all of it
    out = apply_delta(rest, GaussianDelta(log_scales=scales), space="activated")
    assert torch.isfinite(out.log_scales).all()


def test_heads_start_small_but_not_at_rest():
    heads = DeltaHeads(8, 16, 2, ALL_HEADS, bands=4)
    delta = heads(torch.randn(5, 8))
    assert delta.sh.shape == (5, 4, 3) and delta.opacity_logits.shape == (5,)
    assert delta.means.abs().max() > 0
    with pytest.raises(ValueError, match="heads are of"):
        DeltaHeads(8, 16, 2, ("colour",))


# encodings --------------------------------------------------------------------------------------


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


# each by itself ---------------------------------------------------------------------------------


def test_4dgs_reads_half_of_its_time_planes():
    """Quirk 1 of methods B.1: time in [0, 1] where the planes span [-1, 1]."""

    def rows(span: str) -> list[int]:
        model = HexPlaneField(2, 4, 9, (1,), 8, heads=("means",), time_span=span)
        entity = Entity(cloud(), model)
        for time in torch.linspace(0, 1, 21).tolist():
            entity(Moment(time)).means.square().sum().backward()
        grads = model.planes.time[0].grad.abs().amax((0, 2, 3))
        return (grads > 0).nonzero().flatten().tolist()

    assert rows("half") == [4, 5, 6, 7, 8] and rows("whole") == list(range(9))


def test_4dgs_lets_gradients_through_its_lookup_and_d3dgs_does_not():  # methods B.9
    for model, through in (
        (HexPlaneField(4, 6, 5, (1,), 12), True),
        (MlpDeformation(12, 4, 3, 3), False),
    ):
        entity = perturbed(model, cloud())
        out = entity(Moment(0.4))
        (out.means - entity.means).square().sum().backward()
        reached = entity.means.grad is not None and bool(entity.means.grad.abs().max() > 1e-6)
        assert reached is through


def test_the_static_stage():
    for model in (
        HexPlaneField(4, 6, 5, (1,), 12, start=0.2),
        MlpDeformation(12, 4, start=0.2, zero_heads=False),
    ):
        entity = perturbed(model, cloud())
        assert not torch.equal(entity(Moment(0.5)).means, entity.means)  # a finished model moves
        model.set_progress(0.19)
        assert torch.equal(entity(Moment(0.5)).means, entity.means)
        assert entity.regularizers() == {}
        model.set_progress(0.2)
        assert not torch.equal(entity(Moment(0.5)).means, entity.means)


def test_time_noise_fades_and_is_of_training_alone():
    model = MlpDeformation(12, 4, zero_heads=False, time_noise=2.0, noise_until=0.5, frames=10)
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
    with pytest.raises(ValueError, match="frames"):
        MlpDeformation(time_noise=0.1)


def test_plane_penalties_are_4dgs_formula():
    torch.manual_seed(0)
    model = HexPlaneField(2, 5, 6, (1, 2), 8)
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


def test_embedded_starts_alike_for_all_and_grows_its_table():
    model = Embedded(5, 8, 9, 3, fine_until=0.5, width=12)
    entity = Entity(cloud(), model)
    shift = entity(Moment(0.4)).means - entity.means
    torch.testing.assert_close(shift, shift[:1].expand_as(shift))  # zero codes: one motion
    model.set_progress(0.0)
    assert model.fine_rows == 3
    model.set_progress(0.25)
    assert model.fine_rows == 6
    model.set_progress(0.7)
    assert model.fine_rows == 9
    with torch.no_grad():
        model.time_table.copy_(torch.randn(9, 8))
    torch.testing.assert_close(model.time_code(0.25, 9), model.time_table[2])
    torch.testing.assert_close(model.time_code(0.5, 3), model.time_table[4])  # ends and middle
    model.anneal = 0.5
    model.set_progress(0.0)
    torch.testing.assert_close(entity(Moment(0.4)).means, entity.means)


def test_embedded_penalties_by_hand():
    model = Embedded(2, 3, 4, 2, width=8, neighbours=1)
    rest = Gaussians.from_points(torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [5.0, 0, 0]]))
    entity = Entity(rest, model).train()
    with torch.no_grad():
        model.embedding.copy_(torch.tensor([[0.0, 0], [3, 4], [9, 9]]))
        model.time_table.copy_(torch.tensor([[0.0], [1], [3], [6]]).expand(4, 3))
    entity(Moment(0.0))
    found = {k: v.item() for k, v in entity.regularizers().items()}
    near = 5 * math.sqrt(math.exp(-2000 * 1e-4))  # the third is too far to count
    assert found["embedding_smoothness"] == pytest.approx(2 * near / 3, rel=1e-4)
    assert found["table_smoothness"] == pytest.approx(1.0)
    assert found["opacity"] == pytest.approx(0.1, rel=1e-4)
    model.smoothing = "last-row"
    assert float(entity.regularizers()["table_smoothness"]) == pytest.approx((9 + 0) / 2)
    assert "opacity" not in entity.regularizers()  # its graph was given away


def test_codes_of_equal_gaussians_have_a_finite_gradient():
    model = Embedded(2, 3, 4, 2, width=8, neighbours=2)
    entity = Entity(cloud(), model).train()
    entity(Moment(0.3))
    sum(entity.regularizers().values()).backward()
    assert torch.isfinite(model.embedding.grad).all()


def test_se3_moves_rigidly_and_turns_what_it_moves():
    model = Se3Field([0.0, 1.0], width=8, depth=1)
    entity = Entity(cloud(), model)
    with torch.no_grad():
        model.screw.weight.zero_()
        model.screw.bias.copy_(torch.tensor([0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0]))
    moved = entity(Moment(0.5))
    center = (model.box.low + model.box.high) / 2
    x, y, z = (entity.means - center).unbind(-1)
    torch.testing.assert_close(moved.means - center, torch.stack((-y, x, z), -1), atol=1e-5, rtol=0)
    want = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    torch.testing.assert_close(
        moved.covariances(), want @ entity.rest.covariances() @ want.T, atol=1e-6, rtol=0
    )
    points = torch.rand(7, 3) * 2 - 1
    torch.testing.assert_close(
        model.jacobians(points, 0.5), want.expand(7, 3, 3), atol=1e-3, rtol=0
    )
    entity.train()
    entity(Moment(0.5))
    assert float(entity.regularizers()["elastic"]) < 1e-3  # rigid: not elastic


def test_se3_derivatives_against_autograd():
    entity = perturbed(Se3Field([0.0, 1.0], width=12, depth=3), cloud(dtype=torch.float64), 0.1)
    points = torch.rand(60, 3, dtype=torch.float64) * 2 - 1
    errors = []
    for point, jacobian in zip(points, entity.deformation.jacobians(points, 0.3), strict=True):
        exact = torch.autograd.functional.jacobian(
            lambda x: entity.deformation.warp(x[None], 0.3)[0], point
        )
        errors.append(float((jacobian - exact).norm() / exact.norm()))
    errors.sort()  # a kink of a ReLU within the step makes a few of them wrong
    assert errors[30] < 2e-3 and errors[50] < 0.05


def test_stretching_is_elastic_loss():
    model = Se3Field([0.0, 1.0], width=8, depth=1, frequencies=0)
    entity = Entity(cloud(), model).train()
    with torch.no_grad():  # x -> x + 0.5 relu(x) along the first axis
        model.trunk.layers[0].weight.zero_()
        model.trunk.layers[0].bias.zero_()
        model.trunk.layers[0].weight[0, 0] = 1
        model.screw.weight.zero_()
        model.screw.weight[3, 0] = 0.5
    model._seen = (torch.tensor([[0.5, 0.0, 0.0]]), 0.5)
    squared = (math.log(1.5) / 0.03) ** 2
    expected = 2 * squared / (squared + 4)
    assert float(entity.regularizers()["elastic"]) == pytest.approx(expected, rel=1e-3)


def test_slices_change_looks_and_not_motion():
    torch.manual_seed(0)
    plain, sliced = Se3Field([0.0, 1.0], width=8), Se3Field([0.0, 1.0], width=8, ambient=2)
    entity = perturbed(sliced, cloud(), 0.3)
    shared = {k: v for k, v in sliced.state_dict().items() if k in plain.state_dict()}
    plain.load_state_dict(shared)
    other = Entity(cloud(), plain)
    plain.load_state_dict(shared)
    one, two = entity(Moment(0.2)), other(Moment(0.2))
    torch.testing.assert_close(one.means, two.means)
    assert (one.sh - two.sh).abs().max() > 1e-3
    assert (one.sh[:, 1:] == two.sh[:, 1:]).all()  # the constant band alone
    assert (one.opacity_logits - two.opacity_logits).abs().max() > 1e-3
    later = entity(Moment(0.9))
    assert (one.opacity_logits - later.opacity_logits).abs().max() > 1e-4


def test_what_needs_a_clip_says_so():
    with pytest.raises(ValueError, match="needs a clip"):
        Se3Field.from_config(Se3FieldConfig(), BuildContext())
    with pytest.raises(ValueError, match="derived from a clip"):
        HexPlaneField.from_config(HexPlaneFieldConfig(time_resolution=None), BuildContext())


def test_codes_are_of_trained_frames(small_video: Clip):
    context = BuildContext(clip=small_video)
    model = Se3Field.from_config(Se3FieldConfig(), context)
    assert model.codes.times.tolist() == [0.0, 0.5, 1.0]
    planes = HexPlaneField.from_config(HexPlaneFieldConfig(time_resolution=None), context).planes
    assert planes.time[0].shape[1] == 8


@pytest.fixture
def small_video() -> Clip:
    from hoigs.core.camera import Camera
    from hoigs.core.clip import FrameStore

    class Nothing(FrameStore):
        def image(self, position):
            return torch.zeros(4, 4, 3, dtype=torch.uint8)

        def mask(self, entity, position):
            raise KeyError(entity)

        def depth(self, position):
            return None

    camera = Camera.look_at(torch.tensor([0.0, 0, -3]), torch.zeros(3), width=4, height=4, fov_y=1)
    return Clip(
        "small",
        Nothing(),
        [camera] * 5,
        [Moment(i / 4, i) for i in range(5)],
        kinds={},
        bodies={},
        objects={},
        points=torch.zeros(3, 3),
        point_colors=torch.zeros(3, 3),
        split={"train": [0, 2, 4], "test": [1, 3]},
    )
