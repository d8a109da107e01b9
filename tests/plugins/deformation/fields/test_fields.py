"""What every field of the whole scene owes beyond the conformance kit, which also runs in these
settings (tests/testing/test_builtin_components.py): hexplane-field, embedded, se3-field, mlp."""

from __future__ import annotations

import pytest
import torch
from field_cloud import ALL_HEADS, COUNT, cloud, perturbed

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.mlp import MlpConfig, MlpDeformation
from hoigs.plugins.deformation.zoo.embedded import Embedded, EmbeddedConfig
from hoigs.plugins.deformation.zoo.hexplane_field import HexPlaneField, HexPlaneFieldConfig
from hoigs.plugins.deformation.zoo.se3_field import Se3Field, Se3FieldConfig

TIMES = [0.0, 0.3, 1.0]
PLANES = {"channels": 4, "resolution": 6, "multires": (1, 2), "width": 12}
TABLE = {"embedding": 5, "table": 8, "rows": 9, "coarse_rows": 3, "width": 12, "neighbours": 4}
SE3 = {"width": 12, "depth": 3, "skip": 2}
MAKE = {
    "hexplane-field": lambda: HexPlaneField(
        HexPlaneFieldConfig(**PLANES, time_resolution=5, depth=2, heads=ALL_HEADS)
    ),
    "hexplane-4dgs": lambda: HexPlaneField(
        HexPlaneFieldConfig(**PLANES, time_resolution=9, time_span="half", turning="added")
    ),
    "embedded": lambda: Embedded(EmbeddedConfig(**TABLE, depth=2, heads=ALL_HEADS)),
    "embedded-own": lambda: Embedded(
        EmbeddedConfig(**TABLE, turning="added", table_smoothness="last-row")
    ),
    "se3-field": lambda: Se3Field(Se3FieldConfig(**SE3, elastic_points=9), times=TIMES),
    "se3-ambient": lambda: Se3Field(
        Se3FieldConfig(**SE3, ambient=2, ambient_depth=2, ambient_width=8), times=TIMES
    ),
    "mlp-d3dgs": lambda: MlpDeformation(
        MlpConfig(
            width=12,
            depth=4,
            position_frequencies=3,
            time_frequencies=3,
            space="activated",
            turning="added",
            zero_heads=False,
        )
    ),
}


@pytest.fixture(params=MAKE)
def entity(request) -> Entity:
    torch.manual_seed(0)
    return perturbed(MAKE[request.param](), cloud())


def test_it_moves_with_time(entity):
    early, late = entity(Moment(0.1)), entity(Moment(0.8))
    assert (early.means - late.means).abs().max() > 1e-4
    assert (early.quats - late.quats).abs().max() > 1e-4
    assert entity.deformation.input_space == "world"


def test_one_gaussian_moves_as_among_many(entity):
    """Nothing but its own row decides what a Gaussian does."""
    whole = entity(Moment(0.4)).detach().clone()
    entity.apply_topology(
        TopologyChange.keep(torch.arange(COUNT) == 3), entity.canonical[torch.tensor([3])]
    )
    alone = entity(Moment(0.4))
    torch.testing.assert_close(alone.means[0], whole.means[3], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(alone.quats[0], whole.quats[3], rtol=1e-4, atol=1e-5)


def test_times_outside_are_held(entity):  # F9
    for outside, end in ((-0.3, 0.0), (1.7, 1.0)):
        out, at_end = entity(Moment(outside)), entity(Moment(end))
        torch.testing.assert_close(out.means, at_end.means)
        assert all(torch.isfinite(value).all() for value in out.tensors().values())


def test_what_needs_a_clip_says_so():
    with pytest.raises(ValueError, match="needs a clip"):
        Se3Field.from_config(Se3FieldConfig(), BuildContext())
    with pytest.raises(ValueError, match="half the frames of a clip"):
        HexPlaneField.from_config(HexPlaneFieldConfig(time_resolution=None), BuildContext())


def test_codes_are_of_trained_frames(small_video: Clip):
    context = BuildContext(clip=small_video)
    model = Se3Field.from_config(Se3FieldConfig(), context)
    assert model.codes.times.tolist() == [0.0, 0.5, 1.0]
    planes = HexPlaneField.from_config(HexPlaneFieldConfig(time_resolution=None), context).planes
    assert planes.time[0].shape[1] == 8


@pytest.fixture
def small_video() -> Clip:
    from hoigs.core.values.camera import Camera
    from hoigs.core.values.clip import FrameStore

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
        points=torch.zeros(3, 3),
        point_colors=torch.zeros(3, 3),
        split={"train": [0, 2, 4], "test": [1, 3]},
    )
