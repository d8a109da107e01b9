"""AnnyBody: a true T-pose, linear shape, skinning, surface points, textures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import LEFT_WRIST, PART_NAMES, RIGHT_WRIST
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.anny import ASSET, AnnyBody, AnnyRigBody


@pytest.fixture(scope="module")
def body() -> AnnyBody:
    return AnnyBody.from_config(AnnyBody.Config(), BuildContext())


def joint(body: AnnyBody, name: str) -> int:
    return body.joint_names.index(name)


def posed(seed: int = 0, *batch: int, dtype: torch.dtype = torch.float32) -> BodyPose:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *s: torch.randn(*batch, *s, generator=generator, dtype=dtype)  # noqa: E731
    return BodyPose(
        draw(3), 0.3 * draw(21, 3), 0.2 * draw(15, 3), 0.2 * draw(15, 3), draw(3), draw(10)
    )


def test_shapes_and_tree(body: AnnyBody) -> None:
    assert len(body.joint_names) == len(body.parents) == 52
    assert body.parents[0] == -1 and all(0 <= p < j for j, p in enumerate(body.parents) if j)
    assert body.template.shape == (13718, 3) and body.num_betas == 10
    torch.testing.assert_close(body.skinning_weights.sum(1), torch.ones(13718))
    assert body.face_uv.shape == body.faces.shape
    assert int(body.face_uv.max()) < len(body.uv)
    assert set(body.vertex_parts.tolist()) == set(range(len(PART_NAMES)))


def test_limbs_are_as_long_as_those_of_adults(body: AnnyBody) -> None:
    """In parts of the stature, between joint centres: means of men and women by de Leva (1996,
    Journal of Biomechanics 29) and by Dumas et al. (2007, Journal of Biomechanics 40)."""
    vertices, joints = body.shaped(torch.zeros(10))
    stature = vertices[:, 1].max() - vertices[:, 1].min()
    for start, end, share in (
        ("shoulder", "elbow", 0.156), ("elbow", "wrist", 0.155), ("hip", "knee", 0.234),
        ("knee", "ankle", 0.246),
    ):  # fmt: skip
        a, b = (joints[joint(body, f"left_{name}")] for name in (start, end))
        assert float((a - b).norm() / stature) == pytest.approx(share, rel=0.06)


def test_the_rigs_joints_are_kept_for_files_of_before(body: AnnyBody) -> None:
    rig = AnnyRigBody()
    assert joint(rig, "left_elbow") == joint(body, "left_elbow") and rig.num_betas == body.num_betas
    off = rig.shaped(torch.zeros(10))[1] - body.shaped(torch.zeros(10))[1]
    assert 0.01 < float(off[joint(body, "left_shoulder")].norm()) < 0.05
    assert float(off[joint(body, "head")].norm()) < 1e-5


@pytest.mark.parametrize("betas", [torch.zeros(10), torch.linspace(-1.5, 1.5, 10)])
def test_zero_pose_is_a_t_pose(body: AnnyBody, betas: torch.Tensor) -> None:
    vertices, joints = body.shaped(betas)
    direction = lambda a, b: torch.nn.functional.normalize(  # noqa: E731
        joints[joint(body, b)] - joints[joint(body, a)], dim=0
    )
    for side, sign in (("left", 1.0), ("right", -1.0)):
        out = torch.tensor([sign, 0.0, 0.0])
        down = torch.tensor([0.0, -1.0, 0.0])
        for bone in (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "middle1")):
            assert direction(*(f"{side}_{b}" for b in bone)) @ out > np.cos(np.deg2rad(6))
        for bone in (("hip", "knee"), ("knee", "ankle")):
            assert direction(*(f"{side}_{b}" for b in bone)) @ down > np.cos(np.deg2rad(6))
        assert direction(f"{side}_ankle", f"{side}_foot")[2] > 0.8  # toes to +z
        # palms down: the thumb points forward, not up or down
        assert direction(f"{side}_wrist", f"{side}_thumb3")[2] > 0.5
    assert direction("pelvis", "head")[1] > 0.98
    height = vertices[:, 1].max() - vertices[:, 1].min()
    assert 1.4 < height < 2.2
    assert vertices[:, 2].max() < 0.4 and vertices[:, 2].min() > -0.3


def test_zero_pose_output_is_shaped(body: AnnyBody) -> None:
    betas = torch.linspace(-1, 2, 10)
    vertices, joints = body.shaped(betas)
    out = body(BodyPose.zeros().replace(betas=betas))
    torch.testing.assert_close(out.vertices, vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(out.joints, joints, atol=1e-6, rtol=0)


def test_shape_directions_survive_the_turn_into_the_t_pose(body: AnnyBody) -> None:
    """Shaping in the A-pose and then turning equals the T-pose's own shape directions."""
    with np.load(ASSET) as file:
        asset = {k: file[k].astype(np.float64) for k in file.files if k != "joint_names"}
    betas = np.linspace(-2, 2, 10)
    canonical = asset["v_rest"] + np.tensordot(betas, asset["shapedirs"], 1)
    joints = asset["joints"] + np.tensordot(betas, asset["joint_shapedirs"], 1)
    turns = asset["tpose_rot"]
    moved = [joints[0]]
    for j in range(1, 52):
        p = body.parents[j]
        moved.append(moved[p] + turns[p] @ (joints[j] - joints[p]))
    moved = np.stack(moved)
    rows = asset["weight_joints"].astype(int)
    share = asset["weights"] / asset["weights"].sum(1, keepdims=True)
    each = np.einsum("vkab,vkb->vka", turns[rows], canonical[:, None] - joints[rows]) + moved[rows]
    expected = (share[..., None] * each).sum(1)
    vertices, shaped = body.shaped(torch.tensor(betas))
    np.testing.assert_allclose(vertices.numpy(), expected, atol=2e-6)
    np.testing.assert_allclose(shaped.numpy(), moved, atol=2e-6)


def test_bones_keep_their_length_and_the_pelvis_its_place(body: AnnyBody) -> None:
    pose = posed(1)
    _, canonical = body.shaped(pose.betas)
    joints = body(pose).joints
    torch.testing.assert_close(joints[0], canonical[0] + pose.transl)
    for j, parent in enumerate(body.parents[1:], start=1):
        length = (joints[j] - joints[parent]).norm()
        torch.testing.assert_close(
            length, (canonical[j] - canonical[parent]).norm(), atol=1e-5, rtol=1e-5
        )


def test_a_bent_elbow_moves_the_forearm_only(body: AnnyBody) -> None:
    angles = torch.zeros(21, 3)
    angles[joint(body, "left_elbow") - 1] = torch.tensor([0.0, -torch.pi / 2, 0.0])
    before, after = body(BodyPose.zeros()), body(BodyPose.zeros().replace(body=angles))
    forearm = after.joints[LEFT_WRIST] - after.joints[joint(body, "left_elbow")]
    assert forearm[2] > 0.99 * forearm.norm()  # a turn about -y takes +x to +z: forward
    moved = (after.vertices - before.vertices).norm(dim=-1) > 1e-4
    assert set(body.vertex_parts[moved].tolist()) <= {4, 6, 8}
    assert moved[body.vertex_parts == 8].all()
    torch.testing.assert_close(after.joints[RIGHT_WRIST], before.joints[RIGHT_WRIST])


def test_batch_equals_loop_and_betas_may_be_shared(body: AnnyBody) -> None:
    poses = posed(2, 3)
    shared = poses.replace(betas=poses.betas[0])
    for batch in (poses, shared):
        out = body(batch)
        for i in range(3):
            torch.testing.assert_close(
                body(batch.frame(i)).vertices, out.vertices[i], atol=1e-5, rtol=0
            )


def test_skinning_transforms_move_the_shaped_vertices(body: AnnyBody) -> None:
    pose = posed(3)
    vertices, joints = body.shaped(pose.betas)
    transforms = body.skinning_transforms(pose)
    homogeneous = torch.cat((vertices, torch.ones(len(vertices), 1)), 1)
    each = torch.einsum("jab,vb->vja", transforms[:, :3], homogeneous)
    expected = (each * body.skinning_weights[..., None]).sum(1)
    torch.testing.assert_close(body(pose).vertices, expected, atol=1e-5, rtol=0)
    root = axis_angle_to_matrices(pose.global_orient)
    torch.testing.assert_close(transforms[0, :3, :3], root)
    torch.testing.assert_close(
        transforms[0, :3, :3] @ joints[0] + transforms[0, :3, 3], joints[0] + pose.transl
    )


def test_double_precision_and_gradients() -> None:
    body = AnnyBody().double()
    pose = posed(4, dtype=torch.float64)
    weights = torch.randn(13718, 3, generator=torch.Generator().manual_seed(6)).double()

    def objective(angles, transl, betas):
        out = body(pose.replace(body=angles, transl=transl, betas=betas))
        return (out.vertices * weights).sum() + out.joints.square().sum()

    inputs = tuple(x.clone().requires_grad_() for x in (pose.body, pose.transl, pose.betas))
    assert torch.autograd.gradcheck(objective, inputs, fast_mode=True)
    single, double = AnnyBody()(pose.to(torch.float32)), body(pose)
    assert double.vertices.dtype == torch.float64
    torch.testing.assert_close(single.vertices.double(), double.vertices, atol=2e-5, rtol=0)


def test_surface_at_the_vertices(body: AnnyBody) -> None:
    surface = body.surface()
    torch.testing.assert_close(surface.points, body.template)
    torch.testing.assert_close(surface.weights, body.skinning_weights)
    assert (surface.parts == body.vertex_parts).all()
    torch.testing.assert_close(surface.normals.norm(dim=-1), torch.ones(13718))


def test_surface_points_are_spread_by_area(body: AnnyBody) -> None:
    betas = torch.linspace(1, -1, 10)
    surface = body.surface(4000, betas=betas, seed=3)
    vertices, _ = body.shaped(betas)
    corners = vertices[body.faces[surface.faces]]
    torch.testing.assert_close(surface.points, (corners * surface.barycentric[..., None]).sum(1))
    torch.testing.assert_close(surface.barycentric.sum(1), torch.ones(4000))
    assert (surface.barycentric >= 0).all()
    torch.testing.assert_close(surface.weights.sum(1), torch.ones(4000))
    a, b, c = vertices[body.faces].unbind(1)
    areas = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    # any run of faces gets its share of the points, to within one at each end
    share = areas.cumsum(0) / areas.sum() * 4000
    drawn = torch.bincount(surface.faces, minlength=len(areas)).cumsum(0)
    assert (share - drawn).abs().max() <= 1.001
    out = vertices.mean(0) - surface.points
    assert ((surface.normals * out).sum(1) < 0).float().mean() > 0.75  # normals look outwards
    assert 0.005 < surface.spacing.median() < 0.05


def test_surface_is_seeded(body: AnnyBody) -> None:
    first, again, other = (body.surface(500, seed=s).points for s in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_arm_length_of_an_adult(body: AnnyBody) -> None:
    assert 0.6 < float(body.arm_length(torch.zeros(10))) < 0.9


def test_buffers_stay_out_of_checkpoints(body: AnnyBody) -> None:
    assert not body.state_dict()


def test_mean_hands_and_wrong_betas_are_refused(body: AnnyBody) -> None:
    with pytest.raises(HoigsError, match=r"no mean hand.*SmplxBody"):
        body(BodyPose.zeros().replace(hand_pose_convention="mean"))
    with pytest.raises(HoigsError, match=r"takes 10 shape coefficients.*got 7"):
        body(BodyPose.zeros(betas=7))
