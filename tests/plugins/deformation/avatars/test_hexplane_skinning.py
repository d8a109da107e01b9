"""deformation:hexplane-skinning on the toy body."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hoigs.core.interfaces.body import PELVIS
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import ProvidesField, ProvidesSkeleton
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.hexplane_skinning import (
    HexPlaneSkinning,
    HexPlaneSkinningConfig,
    field_subset,
)

COUNT = 200


def human(body, **settings) -> Entity:
    torch.manual_seed(0)
    small = {"resolution": 16, "channels": 8, "time_resolution": 6, "width": 16}
    small |= {"field_points": 160, "refine_poses": False}
    own = {k: settings.pop(k) for k in [*settings] if k in HexPlaneSkinningConfig.model_fields}
    model = HexPlaneSkinning(HexPlaneSkinningConfig(**(small | own)), body=body, **settings)
    return Entity(body.canonical(COUNT, model.betas, model.seed), model)


def perturb(entity: Entity, size: float = 0.1) -> Entity:
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in entity.deformation.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator).to(parameter)
    return entity


def at(pose: BodyPose, time: float = 0.4) -> Moment:
    return Moment(time, poses={"human": pose})


def skinned(body, pose: BodyPose, surface) -> torch.Tensor:
    vertices = body(pose).vertices
    # a point's weights are those of its face's corners mixed, so mixing posed corners is only
    # equal where the corners share weights, as each joint's octahedron does
    return (vertices[body.faces[surface.faces]] * surface.barycentric[..., None]).sum(1)


def test_starts_as_the_skinned_template(toy_body, toy_pose):
    entity = human(toy_body)
    surface = toy_body.surface(COUNT)
    canonical = entity(at(BodyPose.zeros(betas=2)))
    torch.testing.assert_close(canonical.means, surface.points, atol=1e-5, rtol=0)
    identity = torch.eye(3).expand(COUNT, 3, 3)
    torch.testing.assert_close(quats_to_matrices(canonical.quats), identity, atol=1e-6, rtol=0)
    for seed in range(3):
        pose = toy_pose(seed)
        out = entity(at(pose))
        expected = skinned(toy_body, pose, surface)
        torch.testing.assert_close(out.means, expected, atol=1e-4, rtol=0)
        for field in ("log_scales", "opacity_logits", "sh"):
            torch.testing.assert_close(getattr(out, field), getattr(entity.canonical, field))


def test_provides_what_it_says(toy_body):
    model = human(toy_body).deformation
    assert isinstance(model, ProvidesField) and isinstance(model, ProvidesSkeleton)
    assert human(toy_body).kind == "human"


def test_other_shapes_move_the_points(toy_body, toy_pose):
    pose = replace(toy_pose(1), betas=torch.tensor([0.5, -1.0]))
    out = human(toy_body)(at(pose))
    expected = skinned(toy_body, pose, toy_body.surface(COUNT))
    torch.testing.assert_close(out.means, expected, atol=1e-4, rtol=0)
    # the same when the rest itself was made in another shape
    out = human(toy_body, betas=torch.tensor([-0.7, 0.3]))(at(pose))
    torch.testing.assert_close(out.means, expected, atol=1e-4, rtol=0)


def test_turning_the_whole_body_turns_each_gaussian(toy_body):
    entity = perturb(human(toy_body), 0.05)
    still = BodyPose.zeros(betas=2)
    turn = torch.tensor([0.3, -0.8, 0.5])
    before, after = entity(at(still)), entity(at(replace(still, global_orient=turn)))
    rotation = axis_angle_to_matrices(turn)
    torch.testing.assert_close(after.means, before.means @ rotation.mT, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        after.covariances(), rotation @ before.covariances() @ rotation.mT, atol=1e-6, rtol=0
    )


def test_alpha_scales_about_the_pelvis(toy_body, toy_pose):
    entity, pose = human(toy_body), toy_pose(2)
    before = entity(at(pose))
    anchors, arm = entity.deformation.anchors(at(pose)), entity.deformation.arm_length()
    with torch.no_grad():
        entity.deformation.log_alpha.fill_(math.log(1.5))
    after = entity(at(pose))
    pelvis = toy_body(pose).joints[PELVIS]
    torch.testing.assert_close(after.means - pelvis, 1.5 * (before.means - pelvis))
    torch.testing.assert_close(after.scales, 1.5 * before.scales)
    grown = entity.deformation.anchors(at(pose))
    torch.testing.assert_close(grown - pelvis, 1.5 * (anchors - pelvis))
    torch.testing.assert_close(entity.deformation.arm_length(), 1.5 * arm)


def test_alpha_about_the_camera_keeps_the_image(toy_body, toy_pose):  # F17
    centers = torch.tensor([[0.0, 0, -3], [0.5, 0, -3], [1.0, 0, -3]])
    entity = human(toy_body, scale_about="camera", camera_centers=centers)
    pose = toy_pose(0)
    before = entity(at(pose, 0.5)).means - centers[1]
    with torch.no_grad():
        entity.deformation.log_alpha.fill_(0.2)
    after = entity(at(pose, 0.5)).means - centers[1]
    torch.testing.assert_close(after, before * math.exp(0.2))
    with pytest.raises(ValueError, match="camera_centers"):
        human(toy_body, scale_about="camera")


def test_anchors_are_the_posed_joints(toy_body, toy_pose):
    pose = toy_pose(3)
    anchors = human(toy_body).deformation.anchors(at(pose))
    torch.testing.assert_close(anchors, toy_body(pose).joints[[0, 20, 21, 10, 11]])


def test_residual_pose_is_added(toy_body, toy_pose):
    entity, pose = human(toy_body), toy_pose(4)
    change = 0.2 * torch.randn(51, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        entity(at(pose), Residual(pose=change)).means, entity(at(pose.with_residual(change))).means
    )


def test_field_is_read_where_the_body_is(toy_body, toy_pose):
    entity = human(toy_body)
    model = entity.deformation
    pose = toy_pose(5)
    features, places = model.posed_field(entity.canonical, at(pose))
    torch.testing.assert_close(places, toy_body(pose).vertices[model.field_vertices])
    assert features.shape == (len(places), 24) and model.field_width == 24
    relative = (places - toy_body(pose).joints[0]) / 1.25
    torch.testing.assert_close(features, model.planes(relative, 0.4))
    # moving or scaling the person as a whole changes places, not features
    moved = replace(pose, transl=pose.transl + 3)
    with torch.no_grad():
        model.log_alpha.fill_(0.3)
    again, _ = model.posed_field(entity.canonical, at(moved))
    torch.testing.assert_close(again, features, atol=1e-4, rtol=1e-4)


def test_every_part_has_field_points(toy_body):
    model = human(toy_body).deformation
    parts = model.field_parts()
    assert parts.unique().tolist() == list(range(16))
    assert len(field_subset(toy_body.vertex_parts, 16)) == 16
    with pytest.raises(ValueError, match=r"part 3 \(head\)"):
        field_subset(toy_body.vertex_parts[toy_body.vertex_parts != 3], 100)


@pytest.mark.parametrize("head", ["full", "exavatar"])
def test_every_parameter_learns(toy_body, toy_pose, head):
    entity = perturb(human(toy_body, head=head, refine_poses=True, nonrigid=True, num_frames=5))
    moment = at(toy_pose(6), 0.4)
    out = entity(moment)
    g = torch.Generator().manual_seed(2)
    loss = sum(
        (value * torch.randn(value.shape, generator=g)).sum()
        for value in (out.means, out.quats, out.log_scales, out.opacity_logits, out.sh)
    )
    features, places = entity.deformation.posed_field(entity.canonical, moment)
    loss = loss + features.square().sum() + places.sum()
    loss.backward()
    for name, parameter in entity.deformation.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all() and parameter.grad.abs().max() > 0, name
    for name in ("log_scales", "sh") + (("opacity_logits",) if head == "full" else ()):
        assert getattr(entity, name).grad.abs().max() > 0, name
    assert not entity.means.requires_grad and not entity.quats.requires_grad
    if head == "exavatar":
        assert (out.opacities > 0.98).all()


def test_paper_pure_trains_no_rest(toy_body):
    entity = human(toy_body, free_attributes=False)
    assert not any(p.requires_grad for n, p in entity.named_parameters() if "." not in n)


@pytest.mark.parametrize(("head", "owned"), [("full", set()), ("exavatar", {"opacity_logits"})])
def test_places_and_turns_can_be_trained_too(toy_body, toy_pose, head, owned):
    entity = perturb(human(toy_body, free_attributes="all", head=head))
    assert entity.deformation.owns == owned
    entity(Moment(0.2, 1, {"human": toy_pose(3)})).means.square().sum().backward()
    assert entity.means.grad.abs().max() > 0


def test_gradcheck(toy_body, toy_pose):
    entity = perturb(human(toy_body, channels=2, resolution=4, width=8, nonrigid=True)).double()
    pose = toy_pose(7, dtype=torch.float64)
    model = entity.deformation
    canonical = entity.canonical[torch.arange(COUNT)]
    try:
        torch.autograd.gradcheck(
            lambda body, transl, alpha, orient: _outputs(
                model,
                canonical,
                replace(pose, body=body, transl=transl, global_orient=orient),
                alpha,
            ),
            (
                pose.body.clone().requires_grad_(),
                pose.transl.clone().requires_grad_(),
                torch.tensor(0.1, dtype=torch.float64, requires_grad=True),
                pose.global_orient.clone().requires_grad_(),
            ),
            fast_mode=True,
        )
    finally:
        toy_body.float()


def _outputs(model, canonical: Gaussians, pose: BodyPose, alpha: torch.Tensor):
    out = torch.func.functional_call(model, {"log_alpha": alpha}, (canonical, at(pose)))
    return out.means, out.quats, out.log_scales


def test_zero_pose_has_finite_gradients(toy_body):
    entity = human(toy_body, refine_poses=True, num_frames=3)
    out = entity(at(BodyPose.zeros(betas=2)))
    (out.means.sum() + out.quats.sum() + out.log_scales.sum()).backward()
    for name, parameter in entity.deformation.named_parameters():
        if parameter.grad is not None:
            assert torch.isfinite(parameter.grad).all(), name


def test_refinement_of_untrained_frames_comes_from_neighbours(toy_body, toy_pose):
    entity = human(toy_body, refine_poses=True, num_frames=7, trained_frames=[0, 1, 4, 5])
    refinement = entity.deformation.refinement
    with torch.no_grad():
        refinement.transl[:] = torch.arange(7.0)[:, None]
        refinement.transl[[2, 3, 6]] = 100.0  # never trained, so never to be read
    pose = toy_pose(8)
    for frame, value in ((0, 0), (1, 1), (2, 2), (3, 3), (4, 4), (5, 5), (6, 5)):
        moved = entity.deformation.pose(at(pose, frame / 6)).transl - pose.transl
        torch.testing.assert_close(moved, torch.full((3,), float(value)))
    moved = entity.deformation.pose(at(pose, 4.5 / 6)).transl - pose.transl
    torch.testing.assert_close(moved, torch.full((3,), 4.5))
    with pytest.raises(ValueError, match=r"some of 0\.\.6, got 0\.\.7"):
        human(toy_body, refine_poses=True, num_frames=7, trained_frames=[0, 7])


def test_cache_follows_every_change(toy_body, toy_pose):
    entity, moment = perturb(human(toy_body)), at(toy_pose(9))
    adam = torch.optim.Adam(
        [p for p in entity.parameters() if p.requires_grad], lr=1e-2, fused=True
    )
    for _ in range(2):
        loss = entity(moment).means.square().sum()
        adam.zero_grad()
        loss.backward()
        adam.step()
        fresh = entity(moment).means.detach()
        for _ in range(2):
            with torch.no_grad():
                torch.testing.assert_close(entity.eval()(moment).means, fresh)
                torch.testing.assert_close(entity(moment).means, fresh)
                torch.testing.assert_close(entity.train()(moment).means, fresh)
    entity.eval()
    with torch.no_grad():
        entity(moment)
    other = perturb(human(toy_body), 0.3)
    entity.load_state_dict(other.state_dict())
    with torch.no_grad():
        fresh = entity(moment).means
        torch.testing.assert_close(fresh, other(moment).means)
    entity.apply_topology(
        TopologyChange.keep(torch.arange(COUNT) % 2 == 0),
        entity.canonical[torch.arange(0, COUNT, 2)],
    )
    with torch.no_grad():
        torch.testing.assert_close(entity(moment).means, fresh[::2])


def test_regularizers(toy_body, toy_pose):
    entity = human(toy_body, nonrigid=True)
    model, moment = entity.deformation, at(toy_pose(1))
    entity(moment)
    assert all(v == 0 for v in model.regularizers().values())
    # see laplacian_of, free_attributes, nonrigid
    optional = {"laplacian_scale", "laplacian_color", "drift", "shading"}
    assert set(model.regularizers()) >= set(model.regularizer_weights) - optional
    perturb(entity)
    loss = entity(moment).means.sum() + sum(model.regularizers().values())
    loss.backward()
    of_planes = {"time_smoothness", "time_sparsity"}
    of_planes |= {f"nonrigid_{name.removeprefix('time_')}" for name in of_planes}
    assert set(model.regularizers()) == of_planes  # the graph of points is used up
    sum(model.regularizers().values()).backward()
    entity(moment)
    for name, value in model.regularizers().items():
        assert value > 0 and torch.isfinite(value), name


def test_free_means_are_drawn_to_the_surface(toy_body, toy_pose):
    entity = human(toy_body, free_attributes="all")
    entity(at(toy_pose(1)))
    assert entity.regularizers()["drift"] < 1e-12
    with torch.no_grad():
        entity.canonical.means[: COUNT // 2] += 0.02 * torch.tensor([0.6, 0.0, 0.8])
    entity(at(toy_pose(1)))
    penalty = entity.regularizers()["drift"]
    torch.testing.assert_close(penalty, torch.tensor(0.02**2 / 2), rtol=1e-4, atol=0)
    penalty.backward()
    assert entity.canonical.means.grad[: COUNT // 2].abs().sum() > 0


def test_topology_and_resize(toy_body, toy_pose):
    entity = perturb(human(toy_body))
    moment = at(toy_pose(1))
    before = entity(moment).means.detach()
    source = torch.tensor([5, 3, 3, 120])
    change = TopologyChange(source, torch.zeros(4, dtype=torch.bool), torch.zeros(4, 3))
    parts = entity.deformation.point_parts()
    entity.apply_topology(change, entity.canonical.detach()[source])
    torch.testing.assert_close(entity(moment).means, before[source])
    assert torch.equal(entity.deformation.point_parts(), parts[source])
    other = human(toy_body)
    other.resize(4)
    other.load_state_dict(entity.state_dict())
    torch.testing.assert_close(other(moment).means, before[source])
    assert not any("body" in name or "rest_" in name for name in entity.state_dict())


def test_errors_speak(toy_body, toy_pose):
    entity = human(toy_body)
    with pytest.raises(ValueError, match=r'no body pose for "human"; it has \[\'anna\'\]'):
        entity(Moment(0.0, poses={"anna": toy_pose(0)}))
    with pytest.raises(ValueError, match="num_frames"):
        HexPlaneSkinning(body=toy_body)
    with pytest.raises(ValueError, match="needs a body"):
        HexPlaneSkinning.from_config(HexPlaneSkinningConfig(), BuildContext())
    config = HexPlaneSkinningConfig(resolution=4, refine_poses=False)
    model = HexPlaneSkinning(config, body=toy_body, surface=toy_body.surface(10))
    with pytest.raises(ValueError, match="20 canonical Gaussians, but a surface of 10"):
        Entity(toy_body.canonical(20), model)
    with pytest.raises(ValueError, match="from the surface that has their"):
        Entity(toy_body.canonical(20, seed=1), HexPlaneSkinning(config, body=toy_body))


def test_from_config(toy_body):
    config = HexPlaneSkinningConfig(resolution=8, channels=4, refine_poses=False)
    context = BuildContext(entity="anna", body=toy_body, seed=3)
    entity = Entity(toy_body.canonical(50, seed=3), HexPlaneSkinning.from_config(config, context))
    out = entity(Moment(0.0, poses={"anna": BodyPose.zeros(betas=2)}))
    torch.testing.assert_close(out.means, entity.means, atol=1e-5, rtol=0)


def test_the_default_config_is_the_specs(toy_body):
    """By hand and from a spec with default settings: the same parameters from the same seed."""
    given = {"num_frames": 4, "trained_frames": [0, 1, 3]}
    torch.manual_seed(0)
    by_hand = HexPlaneSkinning(body=toy_body, **given)
    clip = clip_of(toy_body, [0, 1, 3])
    context = BuildContext("human", clip, toy_body, clip.bodies["human"])
    torch.manual_seed(0)
    built = HexPlaneSkinning.from_config(HexPlaneSkinning.Config(), context)
    torch.testing.assert_close(by_hand.state_dict(), built.state_dict(), rtol=0, atol=0)
    assert by_hand.refinement.frames.trained == built.refinement.frames.trained


def clip_of(body, train: list[int]) -> Clip:
    """A clip of four frames without images."""
    camera = Camera.look_at(torch.tensor([0.0, 0, -3]), torch.zeros(3), width=4, height=4, fov_y=1)
    poses = BodyPose.zeros(4, betas=2)
    return Clip(
        "still", NoFrames(), [camera] * 4,
        [Moment(i / 3, i, {"human": poses.frame(i)}) for i in range(4)],
        kinds={"human": "human"}, bodies={"human": BodyTrack("body:toy", poses)}, objects={},
        points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3),
        split={"train": train, "test": []},
    )  # fmt: skip


class NoFrames(FrameStore):
    def image(self, position):
        raise KeyError(position)

    def mask(self, entity, position):
        raise KeyError(entity)

    def depth(self, position):
        return None
