"""reader:behave: the built-in clip there and back, and the traps of BEHAVE's folders."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import behave
from layouts.anny_models import write_model
from same import same_cameras, same_poses
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.system.unpickling import load_pickle
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.smpl import SmplhBody
from hoigs.plugins.readers.zoo.behave import BehaveReader


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> SmplhBody:
    return SmplhBody(
        SmplhBody.Config(
            path=write_model(tmp_path_factory.mktemp("m") / "male" / "model.npz", "smplh")
        )
    )


@pytest.fixture(scope="module")
def pelvis(still: Clip, body: SmplhBody) -> Tensor:
    return body.shaped(still.bodies["human"].poses.betas)[1][0]


def same_places(got: Clip, want: Clip) -> None:
    """The object's points, wherever the two clips put its centre: the template's hull encloses."""
    a, b = got.objects["object"], want.objects["object"]
    torch.testing.assert_close(a.rotations, b.rotations, atol=1e-5, rtol=0)
    shift = a.translations - b.translations  # of one body-fixed point, so constant in its frame
    own = torch.einsum("fba,fb->fa", b.rotations, shift)
    torch.testing.assert_close(own, own[:1].expand_as(own), atol=1e-5, rtol=0)
    placed = a.points + own[0]
    low, high = b.points.amin(0) - 1e-4, b.points.amax(0) + 1e-4
    assert bool(((placed >= low) & (placed <= high)).all())
    torch.testing.assert_close(placed.amax(0), high, atol=0.02, rtol=0)


@pytest.mark.parametrize("arrays", [False, True])
def test_round_trip(
    still: Clip, body: SmplhBody, pelvis: Tensor, tmp_path: Path, arrays: bool
) -> None:
    """Camera (in Kinect 1's world), pictures, masks, depth to the millimetre, SMPL+H poses, object
    poses. The layout cannot hold a moving camera, a scene's points, or which frames are tests."""
    folder, want = behave.write(
        still, tmp_path, pelvis, arrays=range(8) if arrays else None
    )  # fmt: skip
    reader = BehaveReader()
    assert reader.matches(folder) and not reader.matches(tmp_path)
    clip = reader.read(folder)
    same_cameras(clip.cameras, want.cameras)
    assert clip.cameras[0].world_to_camera.equal(torch.eye(4))
    for i in range(len(clip)):
        assert clip[i].image.equal(want[i].image)
        assert all(clip[i].masks[n].equal(want[i].masks[n]) for n in want.kinds)
        depth, truth = clip[i].depth, want[i].depth
        assert depth is not None and truth is not None
        assert float((depth - truth).abs().max()) < 6e-4
    track = clip.bodies["human"]
    assert (track.model, track.gender) == ("body:smplh", "male")
    same_poses(track.poses, want.bodies["human"].poses)
    same_places(clip, want)
    assert clip.depth_kind == "metric" and clip.fps == pytest.approx(30, rel=0.02)
    # the body is where the mask is: registration, camera and world belong together
    joints = body(track.poses.frame(0)).joints[:22]
    pixels, _ = clip.cameras[0].project(joints)
    inside = pixels.long().clamp(0, 31)
    shown = clip[0].masks["human"] | clip[0].masks["object"]
    assert shown[inside[:, 1], inside[:, 0]].float().mean() > 0.8


def test_the_other_kinects_are_held_out(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    folder, want = behave.write(still, tmp_path, pelvis)
    clip = BehaveReader().read(folder)
    assert clip.held_out is not None and len(clip.held_out) == len(clip)
    camera = clip.held_out.cameras[0]
    expected = -torch.tensor(behave.KINECT_2["translation"])
    turn = torch.tensor(behave.KINECT_2["rotation"]).reshape(3, 3).float()
    torch.testing.assert_close(camera.world_to_camera[:3, 3], turn.mT @ expected)
    torch.testing.assert_close(camera.center, -expected)
    assert clip.held_out[5].image.equal(want[5].image)
    assert BehaveReader(BehaveReader.Config(held_out=False)).read(folder).held_out is None
    second = BehaveReader(BehaveReader.Config(kinect=2)).read(folder)
    torch.testing.assert_close(second.cameras[0].center, -expected)


def test_frame_times_not_indices(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    """The 30-fps release drops frames that could not be registered (F: BEHAVE#1)."""
    kept = [0, 1, 3, 4, 6, 7]
    folder, want = behave.write(still, tmp_path, pelvis, arrays=kept)
    clip = BehaveReader().read(folder)
    assert len(clip) == len(kept)
    assert clip.provenance["without registration"] == ["t0003.067", "t0003.167"]
    for position, i in enumerate(kept):
        assert clip[position].image.equal(want[i].image)
        same_poses(clip.bodies["human"].poses.frame(position), want.bodies["human"].poses.frame(i))
    with np.load(folder / "smpl_fit_all.npz") as file:
        later = {**file, "frame_times": np.array([f"t{60 + i:08.3f}" for i in range(len(kept))])}
    np.savez(folder / "smpl_fit_all.npz", **later)
    with pytest.raises(ClipError, match="are the fits of this sequence"):
        BehaveReader().read(folder)


def test_frames_are_undistorted(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    """Image, mask and depth by the coefficients after the first four (BEHAVE#27)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = bent = (4.0, -0.1, 0.01, 0.02, 0.05, 0.2, -0.05, 0.01)
    folder, want = behave.write(still, tmp_path, pelvis, distortion=bent)
    clip = BehaveReader().read(folder)
    assert all(not clip[i].image.equal(want[i].image) for i in range(8))
    assert any(not clip[i].masks["human"].equal(want[i].masks["human"]) for i in range(8))
    plain = want.cameras[0]
    same_cameras(clip.cameras, want.cameras)
    # by hand, at one pixel: OpenCV's rational model
    focal, center = plain.K[[0, 1], [0, 1]], plain.K[:2, 2]
    x, y = ((torch.tensor([26.5, 9.5]) - center) / focal).tolist()
    r = x * x + y * y
    bend = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    moved = torch.tensor(
        [x * bend + 2 * p1 * x * y + p2 * (r + 2 * x * x),
         y * bend + p1 * (r + 2 * y * y) + 2 * p2 * x * y]
    )  # fmt: skip
    column, row = (moved * focal + center).long().tolist()
    assert (column, row) != (26, 9), "the bend moves this pixel"
    depth, truth = clip[0].depth, want[0].depth
    assert depth is not None and truth is not None
    assert float(depth[9, 26]) == pytest.approx(float(truth[row, column]), abs=1e-3)


def test_the_template_is_centred_by_its_own_vertices(
    still: Clip, pelvis: Tensor, tmp_path: Path
) -> None:
    """Merging the vertex that is there six times would move the mean by centimetres."""
    import trimesh

    folder, want = behave.write(still, tmp_path, pelvis)
    path = tmp_path / "objects/boxmedium/boxmedium_f1000.ply"
    merged, raw = trimesh.load(path), trimesh.load(path, process=False)
    assert np.linalg.norm(merged.vertices.mean(0) - raw.vertices.mean(0)) > 0.01
    same_places(BehaveReader().read(folder), want)


def test_names_of_balls(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    folder, want = behave.write(still, tmp_path, pelvis, category="basketball")
    assert (folder / "t0003.000/sports ball/fit01").is_dir()
    same_places(BehaveReader().read(folder), want)


def test_frames_without_masks_are_scene_only(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    folder, _ = behave.write(still, tmp_path, pelvis, masks=False)
    with pytest.raises(ClipError, match=r"person_mask\.png.* absent: .*--reader-set masks=false"):
        BehaveReader().read(folder)
    clip = BehaveReader(BehaveReader.Config(masks=False)).read(folder)
    assert clip.kinds == {} and clip.bodies == {} and len(clip.points) > 0


def test_a_partial_folder(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    folder, _ = behave.write(still, tmp_path, pelvis)
    (tmp_path / "calibs/Date03/config/1/config.json").unlink()
    (tmp_path / "objects/boxmedium/boxmedium_f1000.ply").unlink()
    (folder / "t0003.033/k1.color.png").unlink()
    (folder / "t0003.100/k1.obj_rend_mask.png").unlink()
    with pytest.raises(ClipError) as caught:
        BehaveReader().read(folder)
    told = str(caught.value)
    for name, maker in (
        ("config/1/config.json", "calibs.zip"),
        ("boxmedium_f1000.ply", "objects.zip"),
        ("t0003.033/k1.color.jpg or t0003.033/k1.color.png", "video2images"),
        ("t0003.100/k1.obj_rend_mask.png", "segmenter"),
    ):
        assert any(name in line and maker in line for line in told.splitlines()), name


def test_no_registrations_at_all(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    folder, _ = behave.write(still, tmp_path, pelvis, arrays=[0, 1])
    (folder / "smpl_fit_all.npz").unlink()
    with pytest.raises(ClipError, match=r"smpl_fit_all\.npz is absent: .*30-fps release"):
        BehaveReader().read(folder)
    (folder / "object_fit_all.npz").unlink()
    with pytest.raises(ClipError, match=r"person/fit02/person_fit\.pkl \(8 files\) are absent"):
        BehaveReader().read(folder)


def test_a_wrong_folder(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match=r"info\.json is absent"):
        BehaveReader().read(tmp_path)
    with pytest.raises(ClipError, match="is not a folder"):
        BehaveReader().read(tmp_path / "x")


def test_damaged_fits_are_told(still: Clip, pelvis: Tensor, tmp_path: Path) -> None:
    folder, _ = behave.write(still, tmp_path, pelvis)
    path = folder / "t0003.033/person/fit02/person_fit.pkl"
    content = load_pickle(path)
    path.write_bytes(pickle.dumps({**content, "pose": content["pose"][:72]}))
    with pytest.raises(ClipError, match=r"pose: expected numbers of shape \[156\], got \[72\]"):
        BehaveReader().read(folder)
    path.write_bytes(pickle.dumps({**content, "betas": content["betas"] + 4}))
    with pytest.raises(ClipError, match="betas of frame 1 differ"):
        BehaveReader().read(folder)
