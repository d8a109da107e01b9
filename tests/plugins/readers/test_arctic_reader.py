"""reader:arctic: the built-in clip there and back, and the traps of ARCTIC's folders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import arctic
from layouts.anny_models import write_model
from same import same_cameras, same_poses

from hoigs.core.clip_folder.write import write_clip
from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.smpl import SmplxBody, SmplxConfig
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.plugins.readers.zoo.arctic import ArcticReader


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    for gender in ("FEMALE", "NEUTRAL"):
        write_model(folder / f"SMPLX_{gender}.npz", "smplx")
    return folder


@pytest.fixture(scope="module")
def template(models: Path) -> np.ndarray:
    mean = SmplxBody(SmplxBody.Config(path=models / "SMPLX_FEMALE.npz")).template.double().numpy()
    return mean + np.array([0.0, 0.02, 0.0])


def shapeless(clip: Clip) -> Clip:
    """A template stands for the shape, so betas are zero."""
    tracks = {
        n: replace(t, poses=t.poses.replace(betas=torch.zeros_like(t.poses.betas)))
        for n, t in clip.bodies.items()
    }
    return replace(clip, bodies=tracks)


@pytest.mark.parametrize("view", [0, 1])
def test_round_trip(
    builtin: Clip, still: Clip, template: np.ndarray, tmp_path: Path, view: int
) -> None:
    """Cameras (of the head, moving, and one that stands), pictures, SMPL-X poses with fingers, the
    object's poses and parts. The layout cannot hold masks (they lie beside it), depth, betas beside
    a template, points or colours."""
    clip = shapeless(still if view else builtin)
    folder = arctic.write(clip, tmp_path, template, view=view)
    reader = ArcticReader()
    assert reader.matches(folder) and not reader.matches(tmp_path)
    back = reader.read(folder)
    same_cameras(back.cameras, clip.cameras)
    for i in range(len(clip)):
        assert back[i].image.equal(clip[i].image) and back[i].depth is None
        assert all(back[i].masks[n].equal(clip[i].masks[n]) for n in clip.kinds)
    track = back.bodies["human"]
    assert (track.model, track.gender) == ("body:smplx", "female")
    assert track.poses.hand_pose_convention == "flat"
    same_poses(track.poses, clip.bodies["human"].poses)
    thing, want = back.objects["object"], clip.objects["object"]
    torch.testing.assert_close(thing.rotations, want.rotations, atol=1e-5, rtol=0)
    shown = torch.einsum("fab,pb->fpa", thing.rotations, thing.points) + thing.translations[:, None]
    truth = torch.einsum("fab,pb->fpa", want.rotations, want.points) + want.translations[:, None]
    torch.testing.assert_close(shown, truth, atol=1e-5, rtol=0)  # metres from millimetres
    assert thing.moving is not None and thing.moving.any() and not thing.moving.all()


def test_the_sequence_folder_serves_too(still: Clip, template: np.ndarray, tmp_path: Path) -> None:
    folder = arctic.write(shapeless(still), tmp_path, template, view=3).parent
    with pytest.raises(ClipError, match=r"images/s05/box_grab_01/1/ is absent"):
        ArcticReader().read(folder)
    clip = ArcticReader(ArcticReader.Config(view=3)).read(folder)
    assert clip.name == "s05_box_grab_01_3"


def test_gender_and_template_are_required(
    still: Clip, template: np.ndarray, models: Path, tmp_path: Path
) -> None:
    """A neutral mean body in their place is visibly shifted (arctic#52)."""
    folder = arctic.write(shapeless(still), tmp_path, template)
    clip = ArcticReader(ArcticReader.Config(points=100)).read(folder)
    context = BuildContext(body_track=clip.bodies["human"])
    body = SmplxBody.from_config(SmplxConfig(path=models / "SMPLX_FEMALE.npz"), context)
    torch.testing.assert_close(
        body.template.double(), torch.from_numpy(template), atol=1e-6, rtol=0
    )
    with pytest.raises(HoigsError, match="fitted with the female model"):
        SmplxBody.from_config(SmplxConfig(path=models / "SMPLX_NEUTRAL.npz"), context)
    write_clip(clip, tmp_path / "clip")  # and a clip folder keeps both
    kept = ClipFolderReader().read(tmp_path / "clip").bodies["human"]
    assert kept.gender == "female" and kept.template is not None
    assert kept.template.equal(clip.bodies["human"].template)
    data = folder.parents[3]
    (data / "meta/subject_vtemplates/s05.obj").unlink()
    with pytest.raises(ClipError, match=r"subject_vtemplates/s05\.obj is absent"):
        ArcticReader().read(folder)


@pytest.mark.parametrize("shape", [(6,), (1,), (12, 3, 1)])
def test_places_of_the_head_camera_that_do_not_fit_its_turns(
    builtin: Clip, template: np.ndarray, tmp_path: Path, shape: tuple[int, ...]
) -> None:
    folder = arctic.write(shapeless(builtin), tmp_path, template, view=0)
    (path,) = folder.parents[3].rglob("*.egocam.dist.npy")
    table = np.load(path, allow_pickle=True).item()  # of our own making
    table["T_k_cam_np"] = np.zeros(shape)
    np.save(path, table, allow_pickle=True)
    with pytest.raises(ClipError, match=r"T_k_cam_np: expected three numbers for each of"):
        ArcticReader().read(folder)


def test_images_are_offset(still: Clip, template: np.ndarray, tmp_path: Path) -> None:
    folder = arctic.write(shapeless(still), tmp_path, template)
    assert (folder / f"{arctic.OFFSET:05d}.jpg").is_file()
    clip = ArcticReader(ArcticReader.Config(start=2, count=4)).read(folder)
    assert len(clip) == 4 and clip[0].image.equal(still[2].image)
    same_poses(clip.bodies["human"].poses.frame(1), still.bodies["human"].poses.frame(3).replace(
        betas=torch.zeros(10)))  # fmt: skip
    for i in (0, 1, 7):  # recordings begin and end with frames that have no image
        (folder / f"{arctic.OFFSET + i:05d}.jpg").unlink()
    assert len(ArcticReader().read(folder)) == 5
    (folder / f"{arctic.OFFSET + 4:05d}.jpg").unlink()
    with pytest.raises(ClipError, match=r"1/00041\.jpg is absent: .*zc-alexfan/arctic"):
        ArcticReader().read(folder)
    with pytest.raises(ClipError, match=r"no image of frames 7 .*00044 to 00044 \(ioi_offset 37\)"):
        ArcticReader(ArcticReader.Config(start=7)).read(folder)


def test_the_top_turns_about_its_hinge(still: Clip, template: np.ndarray, tmp_path: Path) -> None:
    angles = [0.2, 0.3, 0.4, 0.4, 0.4, 0.5, 0.6, 0.4]
    folder = arctic.write(shapeless(still), tmp_path, template, angles=angles)
    back = ArcticReader().read(folder)
    thing, want = back.objects["object"], still.objects["object"]
    assert thing.moving is not None
    rest = want.points.double() - torch.from_numpy(arctic.ORIGIN)
    turn = axis_angle_to_matrices(torch.tensor([0.0, 0.0, -0.4]).double())
    expected = torch.where(thing.moving[:, None], rest @ turn.mT, rest)
    about = expected - expected.mean(0)
    torch.testing.assert_close(thing.points.double(), about, atol=1e-6, rtol=0)
    assert back.provenance["articulation"] == {"unit": "rad", "least": 0.2, "most": 0.6}


def test_the_head_camera_is_undistorted(
    builtin: Clip, template: np.ndarray, tmp_path: Path
) -> None:
    bent = (0.9, -0.1, 0.01, 0.02, 0.05, 0.2, -0.05, 0.01)
    folder = arctic.write(shapeless(builtin), tmp_path, template, view=0, dist=bent)
    clip = ArcticReader().read(folder)
    assert not clip[0].image.equal(builtin[0].image)
    same_cameras(clip.cameras, builtin.cameras)


def test_masks_come_from_a_segmenter(still: Clip, template: np.ndarray, tmp_path: Path) -> None:
    folder = arctic.write(shapeless(still), tmp_path, template, masks=False)
    with pytest.raises(ClipError) as caught:
        ArcticReader().read(folder)
    told = str(caught.value)
    assert "masks/s05/box_grab_01/1/human/{00037-00044}.png (8 files)" in told
    assert "masks/s05/box_grab_01/1/object/" in told and "your segmenter" in told
    clip = ArcticReader(ArcticReader.Config(masks=False)).read(folder)
    assert clip.kinds == {} and clip.bodies == {} and clip.objects == {}


def test_a_partial_folder(still: Clip, template: np.ndarray, tmp_path: Path) -> None:
    folder = arctic.write(shapeless(still), tmp_path, template)
    data = folder.parents[3]
    for name in ("raw_seqs/s05/box_grab_01.smplx.npy", "meta/object_vtemplates/box/parts.json",
                 "meta/misc.json"):  # fmt: skip
        (data / name).unlink()
        names = [name] if name == "raw_seqs/s05/box_grab_01.smplx.npy" else [*names, name]
    with pytest.raises(ClipError) as caught:
        ArcticReader().read(folder)
    assert all(f"{name} is absent" in str(caught.value) for name in names)
    assert "s03, the test subject, ground truth is withheld" in str(caught.value)


def test_wrong_folders(still: Clip, template: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="is not named as an ARCTIC sequence"):
        ArcticReader().read(tmp_path)
    folder = arctic.write(shapeless(still), tmp_path, template)
    path = folder.parents[3] / "meta/misc.json"
    misc = json.loads(path.read_text())
    misc["s05"]["image_size"] = [[2000, 2800]] * 9
    path.write_text(json.dumps(misc))
    with pytest.raises(ClipError, match=r"is 32x32, its calibration is for 2000x2800.*cropped"):
        ArcticReader().read(folder)
    path.write_text(json.dumps({"s06": misc["s05"]}))
    with pytest.raises(ClipError, match='no subject s05; did you mean "s06"'):
        ArcticReader().read(folder)
