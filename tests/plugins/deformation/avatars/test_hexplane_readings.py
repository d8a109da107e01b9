"""Readings of HOIGS's human: plane fusion, place of phi, delta theta's rule, the Laplacian."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import grid_sample

from hoigs.core.interfaces.body import PELVIS
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.feature_planes import PairedPlanes, ProductPlanes
from hoigs.core.maths.nearest import mesh_edges, mesh_roughness, neighbours_of, point_roughness
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import POSES_EXACT, BodyTrack, Clip, FrameStore
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning, HexPlaneSkinningConfig
from hoigs.plugins.deformation.human_planes import body_planes
from hoigs.plugins.deformation.nonrigid import NonRigidMotion, Shading


def human(body, **settings) -> Entity:
    torch.manual_seed(0)
    sizes = {"resolution": 16, "channels": 8, "time_resolution": 6, "width": 16}
    config = HexPlaneSkinningConfig(field_points=160, refine_poses=False, **(sizes | settings))
    model = HexPlaneSkinning.from_config(config, BuildContext(entity="human", body=body))
    entity = Entity(body.canonical(200, model.betas, model.seed), model)
    with torch.no_grad():  # heads start at zero: nothing would differ
        for parameter in (*model.head.parameters(), *model.planes.parameters()):
            parameter += 0.1 * torch.randn_like(parameter)
    return entity


def sampled(plane: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """[H, W, C] at [N, 2], by torch's own bilinear lookup, in float64."""
    grid = points.double()[None, None]
    found = grid_sample(plane.double().permute(2, 0, 1)[None], grid, align_corners=True)
    return found[0, :, 0].T


@pytest.mark.parametrize("time", [None, 0.3])
def test_product_of_six_planes_equals_its_formula(time):
    torch.manual_seed(0)
    planes = body_planes("product", 5, 16, 7)
    with torch.no_grad():
        for parameter in planes.time:
            parameter += 0.3 * torch.randn_like(parameter)
    assert [p.shape[1] for p in planes.space] == [4, 8, 16] and planes.width == 15
    x = 1.8 * torch.rand(40, 3) - 0.9
    scales = []
    for space, clocks in zip(planes.space, planes.time, strict=True):
        product = torch.ones(40, 5, dtype=torch.float64)
        for plane, axes in zip(space, ((0, 1), (0, 2), (1, 2)), strict=True):
            product = product * sampled(plane, x[:, axes])
        for plane, axis in zip(clocks, range(3), strict=True):
            if time is not None:
                at = torch.stack((x[:, axis], torch.full((40,), 2 * time - 1)), 1)
                product = product * sampled(plane, at)
        scales.append(product)
    found = planes(x, time)
    torch.testing.assert_close(found.double(), torch.cat(scales, 1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("fusion", ["paired", "product"])
def test_both_fusions_are_96_wide_and_start_still(fusion):
    torch.manual_seed(0)
    planes = body_planes(fusion, 32, 16, 8)
    assert isinstance(planes, PairedPlanes if fusion == "paired" else ProductPlanes)
    assert planes.width == 96
    x = 1.8 * torch.rand(2000, 3) - 0.9
    torch.testing.assert_close(planes(x, 0.7), planes(x))  # phi = f before anything is learned
    assert float(planes.time_smoothness().detach()) == 0 == float(planes.time_sparsity().detach())
    assert 0.02 < float(planes(x).detach().std()) < 0.2  # either reading feeds psi_h alike
    with torch.no_grad():
        for parameter in planes.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    assert (planes(x, 0.7) - planes(x)).abs().max() > 1e-3
    assert float(planes.time_smoothness().detach()) > 0 < float(planes.time_sparsity().detach())
    planes(x, 0.4).square().sum().backward()
    assert all(p.grad.abs().max() > 0 for p in planes.parameters())


def test_a_human_of_product_planes_learns(toy_body, toy_pose):
    entity = human(toy_body, fusion="product")
    moment = Moment(0.4, poses={"human": toy_pose(0)})
    entity(moment).means.square().sum().backward()
    assert all(p.grad.abs().max() > 0 for p in entity.deformation.planes.space)
    entity.eval()
    with torch.no_grad():
        before = entity(moment).means
        entity.deformation.planes.space[2].add_(0.2)  # the cache must see it
        assert (entity(moment).means - before).abs().max() > 1e-5


def test_phi_is_read_at_the_posed_or_the_canonical_body(toy_body, toy_pose):
    pose, still = toy_pose(1), BodyPose.zeros(betas=2)
    moments = [Moment(0.4, poses={"human": p}) for p in (pose, still)]
    posed, canonical = (human(toy_body, field_at=at) for at in ("posed", "canonical"))
    model = canonical.deformation
    features, places = model.posed_field(canonical.canonical, moments[0])
    points = toy_body.shaped(torch.zeros(2))[0][model.field_vertices]
    at = (points - toy_body.joints[PELVIS]) / 1.25
    torch.testing.assert_close(features, model.planes(at, 0.4))
    torch.testing.assert_close(features, model.posed_field(canonical.canonical, moments[1])[0])
    # where the parts are, for the distance mask, is the posed body in either reading
    torch.testing.assert_close(
        places, posed.deformation.posed_field(posed.canonical, moments[0])[1]
    )
    moving = [posed.deformation.posed_field(posed.canonical, m)[0] for m in moments]
    assert (moving[0] - moving[1]).abs().max() > 1e-3
    torch.testing.assert_close(moving[1], features)  # in the zero pose they agree
    later = model.posed_field(canonical.canonical, Moment(0.9, poses=moments[0].poses))[0]
    assert (later - features).abs().max() > 1e-3  # time still changes it


def test_delta_theta_is_added_or_composed(toy_body, toy_pose):
    pose = toy_pose(2, size=0.8)
    torch.manual_seed(1)
    delta = 0.5 * torch.randn(51, 3)
    theta = torch.cat((pose.body, pose.left_hand, pose.right_hand)).double()
    composed = pose.with_residual(delta, "compose")
    made = torch.cat((composed.body, composed.left_hand, composed.right_hand)).double()
    expected = axis_angle_to_matrices(delta.double()) @ axis_angle_to_matrices(theta)
    torch.testing.assert_close(axis_angle_to_matrices(made), expected, atol=1e-5, rtol=0)
    added = pose.with_residual(delta)
    torch.testing.assert_close(added.body, pose.body + delta[:21])
    assert (added.body - composed.body).abs().max() > 0.05
    small = pose.with_residual(1e-4 * delta), pose.with_residual(1e-4 * delta, "compose")
    turns = [axis_angle_to_matrices(p.body) for p in small]
    assert (turns[0] - turns[1]).abs().max() < 1e-4  # alike while small
    moment, residual = Moment(0.4, poses={"human": pose}), Residual(pose=delta)
    entities = [human(toy_body, residual_rule=rule) for rule in ("add", "compose")]
    means = [e.deformation(e.canonical, moment, residual).means for e in entities]
    direct = [
        e(Moment(0.4, poses={"human": p})).means
        for e, p in zip(entities, (added, composed), strict=True)
    ]
    torch.testing.assert_close(means, direct)
    assert (means[0] - means[1]).abs().max() > 1e-2


def test_composing_has_gradients_at_rest():
    delta = torch.zeros(51, 3, requires_grad=True)
    made = BodyPose.zeros().with_residual(delta, "compose")
    (made.body * torch.arange(63.0).view(21, 3)).sum().backward()
    torch.testing.assert_close(delta.grad[:21], torch.arange(63.0).view(21, 3))


def octahedron() -> torch.Tensor:
    return torch.tensor([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4],
                         [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])  # fmt: skip


def test_mesh_laplacian_equals_its_definition():
    torch.manual_seed(0)
    values = torch.randn(7, 3, dtype=torch.float64)  # vertex 6 is on no face
    edges = mesh_edges(octahedron())
    assert len(edges) == 24
    total = 0.0
    for v in range(6):
        near = sorted({int(b) for f in octahedron().tolist() if v in f for b in f} - {v})
        assert len(near) == 4
        total += float((values[v] - values[near].mean(0)).square().sum())
    assert float(mesh_roughness(values, edges)) == pytest.approx(total / 7)
    assert float(mesh_roughness(torch.ones(7, 2), edges)) == 0


def test_point_laplacian_equals_its_definition():
    torch.manual_seed(0)
    points, values = torch.randn(30, 3), torch.randn(30, 2, dtype=torch.float64)
    total = 0.0
    for i in range(30):
        order = (points - points[i]).norm(dim=1).argsort()[1:5]
        total += float((values[i] - values[order].mean(0)).square().sum())
    assert float(point_roughness(values, neighbours_of(points))) == pytest.approx(total / 30)
    # the CPU kernel and its gradient against float64
    found = []
    for dtype in (torch.float32, torch.float64):
        leaf = values.to(dtype).requires_grad_()
        rough = point_roughness(leaf, neighbours_of(points))
        found.append([rough.detach().double(), torch.autograd.grad(3 * rough, leaf)[0].double()])
    torch.testing.assert_close(found[0], found[1], rtol=1e-5, atol=1e-7)
    assert neighbours_of(points[:4]) is None


@pytest.mark.parametrize("over", ["points", "mesh"])
def test_laplacian_of_a_human(toy_body, toy_pose, over):
    plain = human(toy_body, laplacian=over)
    plain(Moment(0.4, poses={"human": toy_pose(0)}))
    assert {n for n in plain.deformation.regularizers() if "laplacian" in n} == {"laplacian"}
    entity = human(toy_body, laplacian=over, laplacian_of=("offset", "scale", "color"))
    model = entity.deformation
    entity(Moment(0.4, poses={"human": toy_pose(0)}))
    penalties = model.regularizers()
    with torch.no_grad():
        points = entity.means if over == "points" else toy_body.template
        said = model.head(model.planes((points - toy_body.joints[PELVIS]) / 1.25))
        for name, values in {
            "laplacian": said.offsets,
            "laplacian_scale": said.log_scales,
            "laplacian_color": said.colors,
        }.items():
            if over == "points":
                expected = point_roughness(values, neighbours_of(entity.means))
            else:
                expected = mesh_roughness(values, mesh_edges(toy_body.faces))
            torch.testing.assert_close(penalties[name], expected)
            assert expected > 0
    sum(penalties[n] for n in penalties if n.startswith("laplacian")).backward()
    assert model.planes.space.grad.abs().max() > 0
    assert all(p.grad.abs().max() > 0 for p in list(model.head.parameters())[:2])
    assert not any("edges" in name for name in entity.state_dict())


class DepthOnly(FrameStore):
    """Depth `factor` times that of the posed body, which the mask shows whole."""

    def __init__(self, bodies: list[torch.Tensor], cameras: list[Camera], factor: float) -> None:
        self.shots = []
        for vertices, camera in zip(bodies, cameras, strict=True):
            xy, z = camera.project(vertices)
            at = xy.floor().long()
            depth = torch.full((camera.height * camera.width,), torch.inf)
            depth.scatter_reduce_(0, at[:, 1] * camera.width + at[:, 0], z, "amin")
            depth = depth.view(camera.height, camera.width)
            self.shots.append(torch.where(torch.isfinite(depth), factor * depth, 0.0))

    def image(self, position: int) -> torch.Tensor:
        return torch.zeros((*self.shots[position].shape, 3), dtype=torch.uint8)

    def mask(self, entity: str, position: int) -> torch.Tensor:
        return self.shots[position] > 0

    def depth(self, position: int) -> torch.Tensor | None:
        return self.shots[position]


def clip_of(body, factor: float, kind: str = "metric") -> Clip:
    frames = 3
    poses = BodyPose.zeros(frames, betas=2)
    poses = poses.replace(transl=torch.tensor([[-0.1, 0, 0], [0, 0, 0], [0.1, 0, 0.0]]))
    eye, target = torch.tensor([0.0, 0, -4]), torch.zeros(3)
    cameras = [Camera.look_at(eye, target, width=80, height=80, fov_y=0.8)] * frames
    bodies = [body(poses.frame(i)).vertices for i in range(frames)]
    return Clip(
        "still", DepthOnly(bodies, cameras, factor), cameras,
        [Moment(i / 2, i, {"human": poses.frame(i)}) for i in range(frames)],
        kinds={"human": "human"}, bodies={"human": BodyTrack("body:toy", poses)}, objects={},
        points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3),
        split={"train": [0, 1, 2], "test": []}, depth_kind=kind,
    )  # fmt: skip


def built(body, clip: Clip, **settings) -> HexPlaneSkinning:
    config = HexPlaneSkinningConfig(
        resolution=8, channels=4, width=16, field_points=160, **settings
    )
    context = BuildContext("human", clip, body, clip.bodies["human"])
    return HexPlaneSkinning.from_config(config, context)


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_alpha_starts_at_the_ratio_of_depths(toy_body, factor):  # F16
    clip = clip_of(toy_body, factor)
    model = built(toy_body, clip, alpha_start="depth", scale_about="camera")
    assert float(model.log_alpha.detach().exp()) == pytest.approx(factor, rel=0.03)
    assert float(built(toy_body, clip).log_alpha.detach()) == 0
    for unknown in (clip_of(toy_body, factor, "affine-disparity"), clip_of(toy_body, 0.0)):
        with pytest.raises(ValueError, match='needs metric depth under the mask of "human"'):
            built(toy_body, unknown, alpha_start="depth")


@pytest.mark.parametrize(("about", "seen"), [("camera", False), ("pelvis", True)])
def test_what_moves_alpha(toy_body, about, seen):  # F17
    """About the camera only depth depends on alpha; about the pelvis the image does too."""
    clip = clip_of(toy_body, 1.0)
    model = built(toy_body, clip, scale_about=about, refine_poses=False)
    entity = Entity(toy_body.canonical(200, model.betas, model.seed), model)
    camera, moment = clip.cameras[1], clip.moments[1]
    xy, depth = camera.project(entity(moment).means)
    torch.manual_seed(0)
    of_image = torch.autograd.grad((xy * torch.randn_like(xy)).sum(), model.log_alpha,
                                   retain_graph=True)[0]  # fmt: skip
    of_depth = torch.autograd.grad(depth.sum(), model.log_alpha)[0]
    assert (of_image.abs() > 1.0) if seen else (of_image.abs() < 1e-2)
    if about == "camera":  # d (alpha z) / d log alpha = alpha z
        torch.testing.assert_close(of_depth, depth.sum().detach())


@pytest.mark.parametrize(("provenance", "refined"), [({}, True), ({POSES_EXACT: False}, True),
                                                     ({POSES_EXACT: True}, False)])  # fmt: skip
def test_exact_poses_are_not_refined_by_auto(toy_body, provenance, refined):
    """Nor do people whose poses are exact move but rigidly: only light changes on them."""
    clip = replace(clip_of(toy_body, 1.0), provenance=provenance)
    model = built(toy_body, clip, refine_poses="auto", nonrigid="auto")
    assert (model.refinement is not None) == refined
    assert isinstance(model.nonrigid, NonRigidMotion if refined else Shading)
    model = built(toy_body, clip, refine_poses=True, nonrigid=True)
    assert model.refinement is not None and isinstance(model.nonrigid, NonRigidMotion)
