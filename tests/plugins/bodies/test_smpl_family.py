"""SMPL, SMPL+H and SMPL-X: what converts exactly, what is refused, which file a clip asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_smplh import SMPL_JOINTS, write_smpl, write_smplh
from toy_smplx import PARENTS, by_formulas, write_toy

from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.smpl_params import (
    betas_of_joints,
    moved_pose,
    pose_from_smpl,
    pose_from_smplh,
    pose_from_smplx,
    same_betas,
)
from hoigs.core.values.clip import BodyTrack
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.corrected import file_gender
from hoigs.plugins.bodies.smpl import (
    SmplBody,
    SmplConfig,
    SmplhBody,
    SmplhConfig,
    SmplxBody,
    SmplxConfig,
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    write_toy(folder / "SMPLX_MALE.npz")
    write_toy(folder / "SMPLX_NEUTRAL.npz")
    write_smplh(folder / "male" / "model.npz")
    write_smplh(folder / "female" / "model.npz", mean_hands=False)
    write_smpl(folder / "SMPL_NEUTRAL.npz")
    return folder


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def numbers(pose: BodyPose) -> list[torch.Tensor]:
    return [pose.global_orient, pose.body, pose.left_hand, pose.right_hand, pose.transl, pose.betas]


def test_smplh_vectors_go_there_and_back() -> None:
    vector, transl, betas = 0.4 * draw(5, 156), draw(5, 3, seed=1), draw(10, seed=2)
    pose = pose_from_smplh(vector, transl, betas)
    assert pose.hand_pose_convention == "mean"
    torch.testing.assert_close(pose.body[:, 0], vector[:, 3:6], rtol=0, atol=0)
    torch.testing.assert_close(pose.right_hand[:, -1], vector[:, -3:], rtol=0, atol=0)
    assert torch.equal(pose.rotations.flatten(-2), vector)


def test_smplh_moves_the_skin_as_smplx_does(files: Path) -> None:
    """Of equal toy files, so that only the joints' order can differ."""
    vector = 0.4 * draw(3, 156)
    pose = pose_from_smplh(vector, draw(3, 3, seed=1), draw(10, seed=2), "flat")
    plus_h = SmplhBody(SmplhBody.Config(path=files / "male" / "model.npz")).double()
    smplx = SmplxBody(SmplxBody.Config(path=files / "SMPLX_MALE.npz")).double()
    torch.testing.assert_close(plus_h(pose).vertices, smplx(pose).vertices)
    kept = [*range(22), *range(25, 55)]
    torch.testing.assert_close(plus_h(pose).joints, smplx(pose).joints[:, kept])


def test_smpl_by_its_own_formulas(files: Path) -> None:
    """24 joints, one matrix at a time, against body:smpl behind a BodyPose."""
    vector, transl, betas = 0.4 * draw(72), draw(3, seed=1), draw(10, seed=2)
    body = SmplBody(SmplBody.Config(path=files / "SMPL_NEUTRAL.npz")).double()
    with np.load(files / "SMPL_NEUTRAL.npz") as npz:
        file = dict(npz)
    parents = [PARENTS[j] if j < 22 else (20, 21)[j == 43] for j in SMPL_JOINTS]
    angles = vector.numpy().reshape(-1, 3)
    vertices, _ = by_formulas(file, betas.numpy(), angles, parents)
    pose = pose_from_smpl(vector, transl, betas)
    np.testing.assert_allclose(body(pose).vertices.numpy(), vertices + transl.numpy(), atol=3e-6)


def test_smplx_parameters_flat_or_by_joint() -> None:
    flat = {
        "global_orient": draw(2, 3), "body_pose": draw(2, 63), "left_hand_pose": draw(2, 45),
        "right_hand_pose": draw(2, 45), "transl": draw(2, 3), "betas": draw(10),
        "jaw_pose": draw(2, 3),
    }  # fmt: skip
    by_joint = {**flat, "body_pose": flat["body_pose"].reshape(2, 21, 3)}
    for a, b in zip(*(numbers(pose_from_smplx(p, "flat")) for p in (flat, by_joint)), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(ClipError, match=r"left_hand_pose has 12 numbers a frame.*PCA"):
        pose_from_smplx({**flat, "left_hand_pose": draw(2, 12)}, "flat")
    with pytest.raises(ClipError, match="lack transl"):
        pose_from_smplx({k: v for k, v in flat.items() if k != "transl"}, "flat")


def test_a_pose_moves_with_its_world(files: Path) -> None:
    body = SmplxBody(SmplxBody.Config(path=files / "SMPLX_MALE.npz")).double()
    pose = pose_from_smplh(0.4 * draw(3, 156), draw(3, 3), draw(10), "flat")
    turn, shift = axis_angle_to_matrices(draw(3, seed=8)), draw(3, seed=9)
    pelvis = body.shaped(pose.betas)[1][0]
    moved = moved_pose(pose, pelvis, turn, shift)
    expected = body(pose).vertices @ turn.mT + shift
    torch.testing.assert_close(body(moved).vertices, expected)


def test_a_file_without_mean_hands_refuses_the_mean_convention(files: Path) -> None:
    body = SmplhBody(SmplhBody.Config(path=files / "female" / "model.npz")).double()
    pose = pose_from_smplh(draw(156), draw(3), draw(10))
    with pytest.raises(HoigsError, match="has no mean hand"):
        body(pose)
    body(pose.replace(hand_pose_convention="flat"))


def test_betas_come_back_from_rest_joints(files: Path) -> None:
    body = SmplBody(SmplBody.Config(path=files / "SMPL_NEUTRAL.npz"))
    betas = draw(10).float()
    joints = body.shaped(betas)[1][:22] + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(betas_of_joints(body, joints), betas, atol=1e-3, rtol=1e-3)
    with pytest.raises(ClipError, match="zero-pose joints are not this model's"):
        betas_of_joints(body, 1.2 * joints)


def test_one_person_has_one_shape() -> None:
    shapes = [draw(10) + 0.01 * draw(10, seed=i) for i in range(5)]
    torch.testing.assert_close(same_betas(shapes, "x"), shapes[0], atol=0.05, rtol=0)
    with pytest.raises(ClipError, match="fits: betas of frame 3 differ"):
        same_betas([*shapes[:3], shapes[0] + 4, *shapes[4:]], "fits")


@pytest.mark.parametrize(
    ("name", "gender"),
    [("SMPLX_MALE.npz", "male"), ("smplh/female/model.npz", "female"), ("mine.npz", None),
     ("SMPLX_FEMALE.npz", "female"), ("smpl_male_neutral.npz", None)],
)  # fmt: skip
def test_gender_in_a_files_name(name: str, gender: str | None) -> None:
    assert file_gender(Path("x") / name) == gender


def track(**more: object) -> BodyTrack:
    return BodyTrack("body:smplx", BodyPose.zeros(2), **more)  # type: ignore[arg-type]


def test_a_silent_neutral_body_is_refused(files: Path) -> None:
    male = BuildContext(body_track=track(gender="male"))
    SmplxBody.from_config(SmplxConfig(path=files / "SMPLX_MALE.npz"), male)
    with pytest.raises(HoigsError, match=r"fitted with the male model, .*NEUTRAL.* neutral one"):
        SmplxBody.from_config(SmplxConfig(path=files / "SMPLX_NEUTRAL.npz"), male)
    with pytest.raises(HoigsError, match="fitted with the male model"):
        SmplhBody.from_config(SmplhConfig(path=files / "female" / "model.npz"), male)
    with pytest.raises(HoigsError, match="fitted with the male model"):
        SmplBody.from_config(SmplConfig(path=files / "SMPL_NEUTRAL.npz"), male)


def test_the_clips_template_is_used_and_another_can_be_given(files: Path, tmp_path: Path) -> None:
    import trimesh

    plain = SmplxBody(SmplxBody.Config(path=files / "SMPLX_MALE.npz"))
    own = plain.template + 0.01 * draw(*plain.template.shape).float()
    context = BuildContext(body_track=track(template=own))
    config = SmplxConfig(path=files / "SMPLX_MALE.npz")
    body = SmplxBody.from_config(config, context)
    torch.testing.assert_close(body.template, own)
    assert (body.joints - plain.joints).norm() > 1e-3  # joints follow the template
    mesh = trimesh.Trimesh(plain.template + 1.0, plain.faces, process=False)
    mesh.export(tmp_path / "s01.obj")
    given = SmplxConfig(path=config.path, template=tmp_path / "s01.obj")
    shifted = SmplxBody.from_config(given, context).template
    torch.testing.assert_close(shifted, plain.template + 1.0, atol=1e-5, rtol=0)
    with pytest.raises(HoigsError, match="template has 7 vertices, the model 1100"):
        SmplxBody(config, template=own[:7])
    with pytest.raises(HoigsError, match="no such file"):
        SmplxBody.from_config(SmplxConfig(path=config.path, template=tmp_path / "n.obj"), context)


def test_other_families_files_are_refused(files: Path) -> None:
    for family, path in (
        (SmplxBody, files / "male" / "model.npz"),
        (SmplhBody, files / "SMPL_NEUTRAL.npz"),
        (SmplBody, files / "SMPLX_MALE.npz"),
    ):
        with pytest.raises(HoigsError, match=r"do not fit each other|lacks"):
            family(family.Config(path=path))
    with pytest.raises(HoigsError, match="11"):
        SmplBody(SmplBody.Config(path=files / "SMPL_NEUTRAL.npz", num_betas=11))
