"""deformation:hexplane-skinning and its tokens on the built-in body."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning
from hoigs.plugins.features.body_parts import BodyPartFeatures


@pytest.fixture(scope="module")
def body() -> AnnyBody:
    return AnnyBody()


def moment(pose: BodyPose) -> Moment:
    return Moment(0.5, poses={"human": pose})


@pytest.fixture(scope="module")
def human(body: AnnyBody) -> Entity:
    torch.manual_seed(0)
    model = HexPlaneSkinning(
        HexPlaneSkinning.Config(resolution=16, time_resolution=4, refine_poses=False), body=body
    )
    return Entity(body.canonical(2000), model, BodyPartFeatures())


def test_rest_pose_is_the_surface(body: AnnyBody, human: Entity):
    out = human(moment(BodyPose.zeros(betas=body.num_betas)))
    torch.testing.assert_close(out.means, body.surface(2000).points, atol=1e-4, rtol=0)


def test_posed_points_stay_on_the_skin(body: AnnyBody, human: Entity):
    g = torch.Generator().manual_seed(0)
    pose = BodyPose.zeros(betas=body.num_betas).map(
        lambda x: x + 0.3 * torch.randn(x.shape, generator=g)
    )
    surface = body.surface(2000)
    corners = body(pose).vertices[body.faces[surface.faces]]
    expected = (corners * surface.barycentric[..., None]).sum(1)
    distance = (human(moment(pose)).means - expected).norm(dim=-1)
    assert distance.max() < 0.01 and distance.mean() < 1e-3


def test_shape_and_skeleton(body: AnnyBody, human: Entity):
    pose = BodyPose.zeros(betas=body.num_betas).replace(transl=torch.tensor([1.0, 2, 3]))
    anchors = human.deformation.anchors(moment(pose))
    torch.testing.assert_close(anchors, body(pose).joints[[0, 20, 21, 10, 11]])
    assert 0.55 < human.deformation.arm_length().item() < 0.9
    tokens = human.tokens(moment(pose))
    assert tokens.features.shape == (16, 96)
    assert tokens.positions[3, 1] > tokens.positions[0, 1] > tokens.positions[14, 1]  # head, feet
    assert tokens.positions[8, 0] > tokens.positions[9, 0]  # the left hand is at +x
