"""features: body-parts, spline-motion, embedding."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.splines import catmull_rom, keyframe_position
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning
from hoigs.plugins.deformation.mlp import MlpDeformation
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.features.body_parts import BodyPartFeatures, part_averages
from hoigs.plugins.features.embedding import EmbeddingConfig, EmbeddingFeatures
from hoigs.plugins.features.spline_motion import SplineMotionConfig, SplineMotionFeatures


def human(body, features) -> Entity:
    torch.manual_seed(0)
    model = HexPlaneSkinning(
        HexPlaneSkinning.Config(
            resolution=16, time_resolution=4, field_points=320, refine_poses=False
        ),
        body=body,
    )
    return Entity(body.canonical(100), model, features)


def thing(features, count: int = 12, **settings) -> Entity:
    torch.manual_seed(0)
    points = torch.randn(count, 3)
    model = CubicHermite(CubicHermite.Config(keyframes=5, **settings))
    entity = Entity(Gaussians.from_points(points, scales=0.1), model, features)
    with torch.no_grad():
        model.keyframe_means += 0.3 * torch.randn_like(model.keyframe_means)
    return entity


def test_body_parts_are_means_over_each_part(toy_body, toy_pose):
    entity = human(
        toy_body, BodyPartFeatures.from_config(BodyPartFeatures.Config(), BuildContext())
    )
    moment = Moment(0.3, poses={"human": toy_pose(0)})
    with torch.no_grad():
        entity.deformation.planes.time.normal_()
    tokens = entity.tokens(moment)
    assert tokens.features.shape == (16, 96) and entity.features.width == 96
    assert not entity.features.state_dict()  # averages follow from the body
    features, places = entity.deformation.posed_field(entity.canonical, moment)
    parts = entity.deformation.field_parts()
    for part in range(16):
        torch.testing.assert_close(tokens.features[part], features[parts == part].mean(0))
        torch.testing.assert_close(tokens.positions[part], places[parts == part].mean(0))
    later = entity.tokens(Moment(0.9, poses=moment.poses))
    assert (later.features - tokens.features).abs().max() > 1e-3
    tokens.features.square().sum().backward()
    for parameter in entity.deformation.planes.parameters():
        assert parameter.grad.abs().max() > 0


def test_an_empty_part_is_told():
    with pytest.raises(ValueError, match="right foot"):
        part_averages(torch.arange(15))


def test_body_parts_need_a_field():
    with pytest.raises(ValueError, match=r"field.*Static"):
        Entity(Gaussians.from_points(torch.randn(4, 3)), Static(), BodyPartFeatures())


@pytest.mark.parametrize("kind", ["per-gaussian", "shared", "low-rank"])
def test_spline_motion(kind):
    features = SplineMotionFeatures.from_config(SplineMotionConfig(embedding=kind), BuildContext())
    entity = thing(features)
    tokens = entity.tokens(Moment(0.6))
    assert tokens.features.shape == (12, 32)
    torch.testing.assert_close(tokens.positions, entity(Moment(0.6)).means)
    assert not tokens.positions.requires_grad
    velocity = entity.deformation.velocity(entity.canonical, Moment(0.6))
    code = features.embedded(12, 0.6)
    if kind == "per-gaussian":
        assert features.embedding.shape == (12, 5, 29)
        at = keyframe_position(0.6, features.embedding.shape[1])
        torch.testing.assert_close(code, catmull_rom(features.embedding, at))
    entry = torch.cat((velocity, code, torch.full((12, 1), 0.6)), -1)
    assert entry.shape == (12, 33)
    torch.testing.assert_close(tokens.features, features.mlp(entry))
    (tokens.features * torch.randn(12, 32)).sum().backward()
    for name, parameter in features.named_parameters():
        assert torch.isfinite(parameter.grad).all() and parameter.grad.abs().max() > 0, name
    assert entity.deformation.tangents.grad.abs().max() > 0  # gradients reach the motion


def test_readings_of_the_interpolated_embedding():
    """e(t) between keyframes 2 and 3 against the formulas in float64."""
    time, r = 0.6, 0.4  # of K = 5
    made = {}
    for kind in ("catmull-rom", "zero-tangent", "linear"):
        config = SplineMotionConfig(interpolation=kind)
        features = SplineMotionFeatures.from_config(config, BuildContext())
        thing(features)
        made[kind] = features.embedded(12, time)
        e = features.embedding.double()
        h00, h10, h01, h11 = (2 * r**3 - 3 * r**2 + 1, r**3 - 2 * r**2 + r,
                              -2 * r**3 + 3 * r**2, r**3 - r**2)  # fmt: skip
        expected = {
            "catmull-rom": h00 * e[:, 2] + h10 * (e[:, 3] - e[:, 1]) / 2
            + h01 * e[:, 3] + h11 * (e[:, 4] - e[:, 2]) / 2,
            "zero-tangent": h00 * e[:, 2] + h01 * e[:, 3],
            "linear": (1 - r) * e[:, 2] + r * e[:, 3],
        }[kind]  # fmt: skip
        torch.testing.assert_close(made[kind].double(), expected, atol=1e-6, rtol=0)
    assert (made["linear"] - made["zero-tangent"]).abs().max() > 1e-3


def test_velocity_is_the_derivative_or_the_interpolated_tangents():
    entity = thing(SplineMotionFeatures(SplineMotionConfig(velocity="keyframes")))
    model, features = entity.deformation, entity.features
    with torch.no_grad():
        model.tangents.normal_()
    for k in range(5):  # the derivative at a keyframe is its tangent: both readings agree there
        moment = Moment(k / 4)
        torch.testing.assert_close(
            features._velocity(model, entity.canonical, moment),
            model.velocity(entity.canonical, moment),
        )
    between = Moment(0.375)
    tau = model.tangents.double()
    ends = (tau[:, 2] - tau[:, 0]) / 2, (tau[:, 3] - tau[:, 1]) / 2
    halfway = 0.5 * (tau[:, 1] + tau[:, 2]) + 0.125 * (ends[0] - ends[1])
    read = features._velocity(model, entity.canonical, between)
    torch.testing.assert_close(read.double(), halfway, atol=1e-6, rtol=0)
    assert (read - model.velocity(entity.canonical, between)).abs().max() > 0.1
    entity.tokens(between).features.square().sum().backward()
    assert model.tangents.grad[:, 1:3].abs().max() > 0  # and no position is needed
    assert model.keyframe_means.grad is None
    with pytest.raises(ValueError, match="CubicHermite"):
        thing(
            SplineMotionFeatures(SplineMotionConfig(velocity="keyframes")),
            tangents="finite-difference",
        )
    model.knots.movable = True
    with pytest.raises(ValueError, match="CubicHermite"):
        features.bind(model, entity.canonical)


@pytest.mark.parametrize("width", [32, 33])
def test_both_widths_of_object_tokens(width):
    entity = thing(SplineMotionFeatures(SplineMotionConfig(width=width)))
    assert entity.features.mlp[0].in_features == 33  # 3 + 29 + 1
    assert entity.tokens(Moment(0.3)).features.shape == (12, width)


@pytest.mark.parametrize("kind", ["per-gaussian", "shared", "low-rank"])
def test_rows_of_the_embedding_follow(kind):
    entity = thing(SplineMotionFeatures(SplineMotionConfig(embedding=kind)))
    before = entity.tokens(Moment(0.4)).features.detach()
    source = torch.tensor([4, 4, 0])
    change = TopologyChange(source, torch.zeros(3, dtype=torch.bool), torch.zeros(3, 3))
    entity.apply_topology(change, entity.canonical.detach()[source])
    torch.testing.assert_close(entity.tokens(Moment(0.4)).features, before[source])


@pytest.mark.parametrize("features", [SplineMotionFeatures(), EmbeddingFeatures()])
def test_embeddings_start_small(features):
    thing(features, count=400)
    assert float(features.embedding.detach().std()) == pytest.approx(0.1, rel=0.02)


def test_with_fewer_keyframes_velocities_are_per_longer_interval():
    features = SplineMotionFeatures()
    entity = thing(features)
    settings, changed = features.with_fewer_knots(5, 3)
    assert settings == {"keyframes": 5} and set(changed) == {"mlp.0.weight"}
    weight = features.mlp[0].weight.detach()
    torch.testing.assert_close(changed["mlp.0.weight"][:, :3], weight[:, :3] / 2)
    assert torch.equal(changed["mlp.0.weight"][:, 3:], weight[:, 3:])
    assert len(entity) == 12
    alone = SplineMotionFeatures(SplineMotionConfig(embedding="none"))
    assert alone.with_fewer_knots(5, 3)[0] == {}
    tangents = SplineMotionFeatures(SplineMotionConfig(velocity="keyframes"))
    assert tangents.with_fewer_knots(5, 3) is None


def test_spline_motion_needs_keyframes():
    class Drifting(Static):
        provides = frozenset({"velocity"})

        def velocity(self, canonical, moment):
            return torch.ones_like(canonical.means)

    points = Gaussians.from_points(torch.randn(4, 3))
    with pytest.raises(ValueError, match=r"Drifting.*keyframes"):
        Entity(points, Drifting(), SplineMotionFeatures())
    entity = Entity(
        points, Drifting(), SplineMotionFeatures(SplineMotionConfig(keyframes=3, width=7))
    )
    assert entity.tokens(Moment(0.5)).features.shape == (4, 7)


def test_embedding_of_a_human_stands_at_its_parts(toy_body, toy_pose):
    features = EmbeddingFeatures.from_config(EmbeddingConfig(), BuildContext())
    entity = human(toy_body, features)
    early = entity.tokens(Moment(0.1, poses={"human": BodyPose.zeros(betas=2)}))
    late = entity.tokens(Moment(0.9, poses={"human": toy_pose(1)}))
    assert early.features.shape == (16, 96)
    assert set(features.state_dict()) == {"embedding"}  # averages follow from the body
    assert torch.equal(early.features, late.features)
    torch.testing.assert_close(early.positions[3], torch.tensor([0.0, 0.55, 0.0]))
    assert (early.positions - late.positions).abs().max() > 0.01
    late.features.sum().backward()
    assert (features.embedding.grad == 1).all()


def test_embedding_of_an_object_is_one_a_gaussian():
    entity = Entity(
        Gaussians.from_points(torch.randn(9, 3)),
        MlpDeformation(MlpDeformation.Config(width=8, depth=2)),
        EmbeddingFeatures(),
    )
    tokens = entity.tokens(Moment(0.2))
    assert tokens.features.shape == (9, 96)
    torch.testing.assert_close(tokens.positions, entity.means.detach())
    entity.apply_topology(
        TopologyChange.keep(torch.arange(9) < 4), entity.canonical.detach()[torch.arange(4)]
    )
    torch.testing.assert_close(entity.tokens(Moment(0.2)).features, tokens.features[:4])
    few = Entity(
        Gaussians.from_points(torch.randn(9, 3)),
        Static(),
        EmbeddingFeatures(EmbeddingConfig(tokens=3, width=5)),
    )
    tokens = few.tokens(Moment(0.0))
    assert tokens.features.shape == (3, 5)
    torch.testing.assert_close(tokens.positions, few.means.mean(0).expand(3, 3))


def test_embedding_over_keyframes_is_linear_between_them(toy_body):
    entity = human(toy_body, EmbeddingFeatures.from_config(
        EmbeddingConfig(keyframes=5), BuildContext()))  # fmt: skip
    table = entity.features.embedding
    assert table.shape == (16, 5, 96)
    still = {"human": BodyPose.zeros(betas=2)}
    tokens = entity.tokens(Moment(0.35, poses=still)).features
    expected = 0.6 * table.double()[:, 1] + 0.4 * table.double()[:, 2]
    torch.testing.assert_close(tokens.double(), expected, atol=1e-6, rtol=0)
    tokens.sum().backward()
    assert (table.grad[:, [0, 3, 4]] == 0).all() and (table.grad[:, 1:3] > 0).all()


def test_tokens_without_an_embedding_know_velocity_and_time():
    features = SplineMotionFeatures.from_config(
        SplineMotionConfig(embedding="none"), BuildContext()
    )
    entity = thing(features)
    moment = Moment(0.4)
    tokens = entity.tokens(moment)
    velocity = entity.deformation.velocity(entity.canonical, moment)
    clock = torch.full((12, 1), 0.4)
    expected = features.mlp(torch.cat((velocity, clock), -1))
    torch.testing.assert_close(tokens.features, expected)
    assert {n.partition(".")[0] for n, _ in features.named_parameters()} == {"mlp"}
    still = Entity(entity.canonical, Static(), None)
    with pytest.raises(ValueError, match="velocity"):
        Entity(
            still.canonical, Static(), SplineMotionFeatures(SplineMotionConfig(embedding="none"))
        )
