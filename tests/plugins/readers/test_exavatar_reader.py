"""reader:exavatar: the built-in clip there and back, and what such folders lack."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from layouts import exavatar
from layouts.anny_models import write_model
from same import same_cameras, same_poses

from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.zoo.exavatar import ExavatarReader


@pytest.fixture(scope="module")
def body() -> AnnyBody:
    return AnnyBody()


@pytest.fixture(scope="module")
def smplx(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("models") / "SMPLX_NEUTRAL.npz", "smplx")


def reader_of(smplx: Path) -> ExavatarReader:
    return ExavatarReader(
        ExavatarReader.Config(smplx=smplx, num_betas=10)
    )  # as many as the built-in body has


@pytest.mark.parametrize("form", [{}, {"virtual": True}, {"neuman": True}, {"points": False}])
def test_round_trip(
    builtin: Clip, body: AnnyBody, smplx: Path, tmp_path: Path, form: dict[str, Any]
) -> None:
    """Poses come out of each frame's camera, fingers too; the layout has neither objects nor
    their masks, and depth maps without a common scale."""
    exavatar.write(builtin, tmp_path, body, **form)
    reader = reader_of(smplx)
    assert reader.matches(tmp_path) and not reader.matches(tmp_path / "masks")
    clip = reader.read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    same_poses(clip.bodies["human"].poses, builtin.bodies["human"].poses)
    assert clip.bodies["human"].model == "body:smplx"
    assert clip.bodies["human"].poses.hand_pose_convention == "flat"
    for mine, theirs in zip(clip, builtin, strict=True):
        assert mine.image.equal(theirs.image) and mine.moment.time == theirs.moment.time
        assert mine.masks["human"].equal(theirs.masks["human"])
    assert clip.split == {k: list(v) for k, v in builtin.split.items()}
    nearest = (clip.points[:, None] - builtin.points[None]).norm(dim=-1).min(1)
    assert float(nearest.values.max()) < 1e-5 and len(clip.points) == len(builtin.points)
    assert (clip.point_colors - builtin.point_colors[nearest.indices]).abs().max() < 0.51 / 255


def test_poses_need_a_model_unless_the_camera_is_the_world(
    builtin: Clip, body: AnnyBody, tmp_path: Path
) -> None:
    """transl is of the template's origin, but turning to the world turns about the pelvis."""
    exavatar.write(builtin, tmp_path / "moving", body)
    clip = ExavatarReader().read(tmp_path / "moving")
    assert not clip.bodies and clip.kinds == {"human": "human"}
    assert "--reader-set smplx=" in clip.provenance["poses of human"]
    exavatar.write(builtin, tmp_path / "still", body, virtual=True)
    for path in (tmp_path / "still/cam_params").iterdir():
        camera = json.loads(path.read_text())
        camera |= {"R": torch.eye(3).tolist(), "t": [0.0, 0.0, 0.0]}
        path.write_text(json.dumps(camera))
    still = ExavatarReader(ExavatarReader.Config(num_betas=10)).read(tmp_path / "still")
    written = json.loads(
        (tmp_path / "still/smplx_optimized/smplx_params_smoothed/3.json").read_text()
    )
    got = still.bodies["human"].poses.frame(3)
    assert torch.allclose(got.transl, torch.tensor(written["trans"]), atol=1e-6)
    assert torch.allclose(got.left_hand, torch.tensor(written["lhand_pose"]), atol=1e-6)


def test_frame_numbers_may_have_a_stride(
    builtin: Clip, body: AnnyBody, smplx: Path, tmp_path: Path
) -> None:
    """Numbers, not their order as text (10 before 5), pair all files."""
    exavatar.write(builtin, tmp_path, body, step=5)
    clip = reader_of(smplx).read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    same_poses(clip.bodies["human"].poses, builtin.bodies["human"].poses)
    assert [m.index for m in clip.moments] == list(range(8)) and clip.num_frames == 8


def test_the_shape_has_as_many_coefficients_as_the_model(
    builtin: Clip, body: AnnyBody, smplx: Path, tmp_path: Path
) -> None:
    exavatar.write(builtin, tmp_path, body)
    with pytest.raises(HoigsError, match="has 10 shape directions, num_betas is 100"):
        ExavatarReader(ExavatarReader.Config(smplx=smplx)).read(tmp_path)


def test_a_partial_folder_is_told_in_one_message(
    builtin: Clip, body: AnnyBody, tmp_path: Path
) -> None:
    exavatar.write(builtin, tmp_path, body)
    shutil.rmtree(tmp_path / "smplx_optimized/smplx_params_smoothed")
    shutil.rmtree(tmp_path / "masks")
    (tmp_path / "frame_list_test.txt").unlink()
    (tmp_path / "sparse/points3D.txt").unlink()
    with pytest.raises(ClipError) as caught:
        ExavatarReader().read(tmp_path)
    message = str(caught.value)
    for part in (
        "smplx_optimized/smplx_params_smoothed/ is absent: ExAvatar's fitting makes it",
        "masks/ is absent",
        "frame_list_test.txt is absent: you write it: one frame number on each line",
        "sparse/points3D.txt or sparse/points3D.bin or bkg_point_cloud.txt is absent: COLMAP",
    ):
        assert part in message


def test_what_listed_frames_lack(builtin: Clip, body: AnnyBody, tmp_path: Path) -> None:
    exavatar.write(builtin, tmp_path, body, order=(0, 1, 2, 3, 4, 6, 7))
    (tmp_path / "masks/1.png").unlink()
    (tmp_path / "frames/2.png").unlink()
    (tmp_path / "smplx_optimized/smplx_params_smoothed/3.json").unlink()
    with (tmp_path / "frame_list_test.txt").open("a") as lines:
        lines.write(f"{builtin.split['train'][0]}\n")
    with pytest.raises(ClipError) as caught:
        ExavatarReader().read(tmp_path)
    message = str(caught.value)
    for part in (
        "masks/1.png is absent",
        "frames/2.png is absent",
        "smplx_optimized/smplx_params_smoothed/3.json is absent",
        "sparse/ has no camera for 1 of 8 listed frames (5)",
        "1 frames are in both train and test lists (first 0)",
    ):
        assert part in message


def test_no_cameras_at_all(builtin: Clip, body: AnnyBody, tmp_path: Path) -> None:
    exavatar.write(builtin, tmp_path, body, virtual=True)
    shutil.rmtree(tmp_path / "cam_params")
    with pytest.raises(ClipError, match=r"sparse/cameras\.txt or cam_params/ is absent: COLMAP ma"):
        ExavatarReader().read(tmp_path)
    with pytest.raises(ClipError, match="is not a folder"):
        ExavatarReader().read(tmp_path / "no")


def test_broken_files_are_named(builtin: Clip, body: AnnyBody, smplx: Path, tmp_path: Path) -> None:
    exavatar.write(builtin, tmp_path, body)
    path = tmp_path / "smplx_optimized/smplx_params_smoothed/4.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "body_pose": content["body_pose"][:20]}))
    with pytest.raises(ClipError, match=r"4\.json: body_pose has 60 numbers, others have 63"):
        reader_of(smplx).read(tmp_path)
    path.write_text(json.dumps({k: v for k, v in content.items() if k != "trans"}))
    with pytest.raises(ClipError, match=r"4\.json does not have .*\n  trans: Field required"):
        reader_of(smplx).read(tmp_path)
    (tmp_path / "frame_list_train.txt").write_text("0\nframe7.png\n")
    with pytest.raises(ClipError, match=r"frame_list_train\.txt has the line 'frame7\.png'"):
        reader_of(smplx).read(tmp_path)
