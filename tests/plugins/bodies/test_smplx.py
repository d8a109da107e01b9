"""SmplxBody on a toy file of the same layout, against a direct transcription of the formulas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_smplx import PARENTS, by_formulas, toy_smplx, write_toy

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.smpl import SmplxBody, SmplxConfig


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy(tmp_path_factory.mktemp("smplx") / "SMPLX_NEUTRAL.npz")


@pytest.fixture(scope="module")
def body(path: Path) -> SmplxBody:
    return SmplxBody(SmplxBody.Config(path=path)).double()


def random_pose(*batch: int, seed: int = 0, betas: int = 10) -> BodyPose:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *s: torch.randn(*batch, *s, generator=generator, dtype=torch.float64)  # noqa: E731
    return BodyPose(
        draw(3), 0.4 * draw(21, 3), 0.3 * draw(15, 3), 0.3 * draw(15, 3), draw(3), draw(betas)
    )


def reference(pose: BodyPose) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and joints by the formulas of SMPL-X."""
    numbers = lambda x: x.numpy().reshape(-1, 3)  # noqa: E731
    angles = np.concatenate(
        (numbers(pose.global_orient), numbers(pose.body), np.zeros((3, 3)),
         numbers(pose.left_hand), numbers(pose.right_hand))
    )  # fmt: skip
    vertices, joints = by_formulas(toy_smplx(), pose.betas.numpy(), angles, PARENTS)
    transl = pose.transl.numpy()
    return vertices + transl, joints + transl


def test_matches_the_formulas_of_smplx(body: SmplxBody) -> None:
    pose = random_pose()
    vertices, joints = reference(pose)
    out = body(pose)
    # the file is kept in single precision
    np.testing.assert_allclose(out.vertices.numpy(), vertices, atol=3e-6)
    np.testing.assert_allclose(out.joints.numpy(), joints, atol=3e-6)


def test_zero_pose_is_the_shaped_template(body: SmplxBody) -> None:
    pose = BodyPose.zeros(dtype=torch.float64).replace(betas=torch.randn(10).double())
    vertices, joints = body.shaped(pose.betas)
    out = body(pose)
    torch.testing.assert_close(out.vertices, vertices)
    torch.testing.assert_close(out.joints, joints)


def test_pelvis_is_rest_pelvis_plus_transl(body: SmplxBody) -> None:
    pose = random_pose(seed=1)
    _, joints = body.shaped(pose.betas)
    assert joints[0].norm() > 0.1  # the identity would be trivial at the origin
    torch.testing.assert_close(body(pose).joints[0], joints[0] + pose.transl)


def test_global_orientation_turns_about_the_pelvis(body: SmplxBody) -> None:
    pose = random_pose(seed=2)
    still = pose.replace(global_orient=torch.zeros(3, dtype=torch.float64))
    turn = axis_angle_to_matrices(pose.global_orient)
    at_rest, turned = body(still), body(pose)
    pelvis = at_rest.joints[0]
    torch.testing.assert_close(turned.joints, (at_rest.joints - pelvis) @ turn.mT + pelvis)
    torch.testing.assert_close(turned.vertices, (at_rest.vertices - pelvis) @ turn.mT + pelvis)


@pytest.mark.parametrize("batched_betas", [False, True])
def test_batch_equals_loop(body: SmplxBody, batched_betas: bool) -> None:
    poses = random_pose(2, 3, seed=3)
    if not batched_betas:
        poses = poses.replace(betas=poses.betas[0, 0])
    out, transforms = body(poses), body.skinning_transforms(poses)
    assert out.vertices.shape == (2, 3, 1100, 3)
    for i in range(2):
        for k in range(3):
            betas = poses.betas[i, k] if batched_betas else poses.betas
            one = poses.map(lambda x, i=i, k=k: x[i, k] if x.dim() > 1 else x).replace(betas=betas)
            torch.testing.assert_close(body(one).vertices, out.vertices[i, k])
            torch.testing.assert_close(body(one).joints, out.joints[i, k])
            torch.testing.assert_close(body.skinning_transforms(one), transforms[i, k])


def test_gradients_of_pose_shape_and_translation(body: SmplxBody) -> None:
    pose = random_pose(seed=4)
    pose = pose.replace(global_orient=torch.zeros(3, dtype=torch.float64))  # smooth at zero too
    weights = torch.randn(1100, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))

    def objective(orient, angles, hand, transl, betas):
        changed = pose.replace(
            global_orient=orient, body=angles, left_hand=hand, transl=transl, betas=betas
        )
        out = body(changed)
        return (out.vertices * weights).sum(), out.joints.square().sum()

    inputs = (pose.global_orient, pose.body, pose.left_hand, pose.transl, pose.betas)
    inputs = tuple(x.clone().requires_grad_() for x in inputs)
    assert torch.autograd.gradcheck(objective, inputs, fast_mode=True)


def test_mean_hand_convention(body: SmplxBody) -> None:
    file = toy_smplx()
    mean = random_pose(seed=6).replace(hand_pose_convention="mean")
    flat = body.flat_hands(mean)
    assert flat.hand_pose_convention == "flat"
    expected = mean.left_hand.numpy() + file["hands_meanl"].reshape(15, 3)
    np.testing.assert_allclose(flat.left_hand.numpy(), expected, atol=1e-6)
    torch.testing.assert_close(body(mean).vertices, body(flat).vertices)
    same_numbers = mean.replace(hand_pose_convention="flat")
    assert (body(mean).vertices - body(same_numbers).vertices).abs().max() > 1e-3
    assert body.flat_hands(flat) is flat


def test_root_parent_and_face_joints(body: SmplxBody) -> None:
    assert body.parents == PARENTS
    assert len(body.joint_names) == 55
    assert body.joint_names[25] == "left_index1"
    # jaw and eyes belong to the head, and BodyPose never turns them
    assert (body.vertex_parts.reshape(55, -1)[22:25] == 3).all()
    rotations = body.joint_rotations(random_pose())
    assert (rotations[22:25] == 0).all() and (rotations[25:] != 0).all()


def test_number_of_betas(path: Path, tmp_path: Path) -> None:
    body = SmplxBody(SmplxBody.Config(path=path, num_betas=4))
    assert body.shaped(torch.zeros(4))[0].shape == (1100, 3)
    with pytest.raises(HoigsError, match=r"takes 4 shape coefficients.*got 10"):
        body(BodyPose.zeros())
    with pytest.raises(HoigsError, match=r"has 10 shape directions, num_betas is 11"):
        SmplxBody(SmplxBody.Config(path=path, num_betas=11))
    big = write_toy(tmp_path / "big.npz", shapedirs=toy_smplx(directions=400)["shapedirs"])
    assert SmplxBody(SmplxBody.Config(path=big, num_betas=300)).num_betas == 300


def test_config_builds_it(path: Path) -> None:
    config = SmplxConfig(path=path, num_betas=6)
    assert SmplxBody.from_config(config, BuildContext()).num_betas == 6
    with pytest.raises(ValueError, match="num_beta"):
        SmplxConfig(path=path, num_beta=6)


def test_absent_file_says_where_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(HoigsError, match=r"no file .*nothing\.npz.*smpl-x\.is\.tue\.mpg\.de"):
        SmplxBody(SmplxBody.Config(path=tmp_path / "nothing.npz"))


def test_partial_file_names_the_absent_keys(tmp_path: Path) -> None:
    arrays = toy_smplx()
    del arrays["posedirs"], arrays["hands_meanl"]
    np.savez(tmp_path / "part.npz", **arrays)
    with pytest.raises(HoigsError, match=r"lacks posedirs, hands_meanl .*registered"):
        SmplxBody(SmplxBody.Config(path=tmp_path / "part.npz"))


def test_smpl_file_is_refused(tmp_path: Path) -> None:
    path = write_toy(tmp_path / "smplh.npz", weights=np.ones((1100, 52)))
    with pytest.raises(HoigsError, match=r"weights has shape \[1100, 52\].*\[1100, 55\].*SMPL\+H"):
        SmplxBody(SmplxBody.Config(path=path))


def test_other_files_are_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.npz"
    text.write_text("not an archive")
    with pytest.raises(HoigsError, match=r"not an SMPL-X \.npz"):
        SmplxBody(SmplxBody.Config(path=text))
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(HoigsError, match=r"not an SMPL-X \.npz"):
        SmplxBody(SmplxBody.Config(path=tmp_path / "array.npy"))
    template = toy_smplx()["v_template"]
    template[3] = np.nan
    with pytest.raises(HoigsError, match="v_template holds NaN"):
        path = write_toy(tmp_path / "nan.npz", v_template=template)
        SmplxBody(SmplxBody.Config(path=path))
