"""reader:hosnerf: the built-in clip there and back, and the traps of HOSNeRF's folders."""

from __future__ import annotations

import pickle
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from layouts import hosnerf
from layouts.anny_models import write_model
from layouts.changed import picked, without_fingers
from same import same_cameras, same_poses

from hoigs.core.errors import ClipError
from hoigs.core.system.unpickling import load_pickle
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.smpl import SmplBody
from hoigs.plugins.readers.zoo.hosnerf import HosnerfReader, published_split


@pytest.fixture(scope="module")
def smpl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("models") / "SMPL_NEUTRAL.npz", "smpl")


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = load_pickle(path)
    change(content)
    path.write_bytes(pickle.dumps(content))


@pytest.mark.parametrize("centred", [True, False])
def test_round_trip(builtin: Clip, smpl: Path, tmp_path: Path, centred: bool) -> None:
    """Cameras, pictures, masks and poses, in metres from another unit. The layout cannot hold
    fingers (SMPL), which pixels of the foreground are the object's, depth, points, an object's
    track, or how fast the video ran."""
    body = SmplBody(SmplBody.Config(path=smpl))
    clip = without_fingers(builtin)
    hosnerf.write(clip, tmp_path / "scene", body, centred=centred)
    reader = HosnerfReader(HosnerfReader.Config(smpl=smpl, points=500))
    assert reader.matches(tmp_path / "scene") and not reader.matches(tmp_path)
    back = reader.read(tmp_path / "scene")
    same_cameras(back.cameras, clip.cameras)
    assert back.kinds == {"human": "human"} and back.objects == {}
    for i in range(len(clip)):
        union = clip[i].masks["human"] | clip[i].masks["object"]
        assert back[i].masks["human"].equal(union) and back[i].image.equal(clip[i].image)
        assert back[i].depth is None and back.moments[i].time == clip.moments[i].time
    track = back.bodies["human"]
    assert track.model == "body:smpl"
    same_poses(track.poses, clip.bodies["human"].poses, 2e-5)
    same_poses(back.moments[3].poses["human"], clip.bodies["human"].poses.frame(3), 2e-5)
    assert back.provenance["transitions"] == [0.5]
    ahead = torch.cat([back.cameras[0].to_camera(back.points)[:, 2]])
    assert len(back.points) >= 500 and ahead.median() > 0.8


def test_frames_are_matched_by_name(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    """HOSNeRF's own code pairs by running index, so its dictionaries must be in order (F52)."""
    clip = without_fingers(builtin)
    order = list(range(len(clip)))
    random.Random(1).shuffle(order)
    hosnerf.write(clip, tmp_path, SmplBody(SmplBody.Config(path=smpl)), order=order)
    back = HosnerfReader(HosnerfReader.Config(smpl=smpl, points=10)).read(tmp_path)
    same_cameras(back.cameras, clip.cameras)
    same_poses(back.bodies["human"].poses, clip.bodies["human"].poses, 2e-5)


def test_frame_0_is_a_test_frame(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    split = published_split(300)
    assert split["test"] == list(range(0, 271, 18)) and split["train"][0] == 1
    assert set(range(271, 300)) <= set(split["train"])
    clip = without_fingers(picked(builtin, [i % 8 for i in range(34)]))
    hosnerf.write(clip, tmp_path, SmplBody(SmplBody.Config(path=smpl)))
    assert HosnerfReader(HosnerfReader.Config(points=10)).read(tmp_path).split["test"] == list(
        range(0, 32, 2)
    )


def test_without_a_model_there_are_no_poses_but_a_clip(
    builtin: Clip, smpl: Path, tmp_path: Path
) -> None:
    hosnerf.write(without_fingers(builtin), tmp_path, SmplBody(SmplBody.Config(path=smpl)))
    clip = HosnerfReader(HosnerfReader.Config(points=10)).read(tmp_path)
    assert clip.bodies == {} and "smpl=SMPL_NEUTRAL.npz" in clip.provenance["poses of human"]
    same_cameras(clip.cameras, builtin.cameras)


def test_each_frame_may_have_another_shape(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    """As HumanNeRF's preparation leaves it; the person's is their mean."""
    clip, body = without_fingers(builtin), SmplBody(SmplBody.Config(path=smpl))
    hosnerf.write(clip, tmp_path, body)
    betas = clip.bodies["human"].poses.betas
    offsets = 0.5 * torch.randn(8, len(betas), generator=torch.Generator().manual_seed(0))
    offsets -= offsets.mean(0)
    joints = body.shaped(betas + offsets)[1][:, [*range(22), 25, 40]].double().numpy()

    def own(content: dict[str, Any]) -> None:
        for entry, rest in zip(content.values(), joints, strict=True):
            entry["tpose_joints"] = rest - rest[:1]

    edit(tmp_path / "mesh_infos.pkl", own)
    track = HosnerfReader(HosnerfReader.Config(smpl=smpl, points=10)).read(tmp_path).bodies["human"]
    torch.testing.assert_close(track.poses.betas, betas, atol=1e-3, rtol=0)
    assert "vary by" in track.provenance
    edit(tmp_path / "mesh_infos.pkl", lambda m: m["000003"]["tpose_joints"].__imul__(1.5))
    with pytest.raises(ClipError, match="they are not of one person"):
        HosnerfReader(HosnerfReader.Config(smpl=smpl)).read(tmp_path)


def test_masks_of_the_object_may_be_added(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    hosnerf.write(
        without_fingers(builtin), tmp_path, SmplBody(SmplBody.Config(path=smpl)), object_masks=True
    )
    clip = HosnerfReader(HosnerfReader.Config(points=10)).read(tmp_path)
    assert clip.kinds == {"human": "human", "object": "object"}
    for name in clip.kinds:
        assert all(clip[i].masks[name].equal(builtin[i].masks[name]) for i in range(8))
    (tmp_path / "object_masks" / "000003.png").unlink()
    with pytest.raises(ClipError, match=r"object_masks/000003\.png is absent: your segmenter"):
        HosnerfReader().read(tmp_path)


def test_distortion_is_taken_out(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    bent = (-0.2, 0.05, 0.0, 0.0)
    hosnerf.write(
        without_fingers(builtin), tmp_path, SmplBody(SmplBody.Config(path=smpl)), distortions=bent
    )
    clip = HosnerfReader(HosnerfReader.Config(points=10)).read(tmp_path)
    assert not clip[0].image.equal(builtin[0].image)
    same_cameras(clip.cameras, builtin.cameras)


def test_a_partial_folder(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    hosnerf.write(without_fingers(builtin), tmp_path, SmplBody(SmplBody.Config(path=smpl)))
    for name in ("cameras.pkl", "poses_bounds.npy", "masks/000002.png", "masks/000003.png"):
        (tmp_path / name).unlink()
    with pytest.raises(ClipError) as caught:
        HosnerfReader().read(tmp_path)
    lines = str(caught.value).splitlines()
    assert len(lines) == 4 and all("TencentARC/HOSNeRF" in line for line in lines[1:])
    told = "\n".join(lines)
    for name in ("cameras.pkl", "poses_bounds.npy", "masks/{000002-000003}.png"):
        assert name in told


def test_a_wrong_folder(tmp_path: Path) -> None:
    assert not HosnerfReader().matches(tmp_path)
    with pytest.raises(ClipError, match="HOSNeRF scene") as caught:
        HosnerfReader().read(tmp_path)
    for name in ("cameras.pkl", "mesh_infos.pkl", "poses_bounds.npy", "images/00000.png"):
        assert name in str(caught.value)


def test_inconsistent_files_are_named(builtin: Clip, smpl: Path, tmp_path: Path) -> None:
    clip = without_fingers(builtin)

    def broken(name: str, change: Callable[[Path], object], message: str) -> None:
        folder = tmp_path / name
        hosnerf.write(clip, folder, SmplBody(SmplBody.Config(path=smpl)))
        change(folder)
        with pytest.raises(ClipError, match=message):
            HosnerfReader(HosnerfReader.Config(smpl=smpl)).read(folder)

    def cameras(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
        edit(folder / "cameras.pkl", change)

    broken("names", lambda f: cameras(f, lambda c: c.pop("000004")), r"1 of 8 images \(000004\)")
    broken("key", lambda f: cameras(f, lambda c: c["000001"].pop("smpl_to_world")), "000001 has no")
    broken(
        "scale",
        lambda f: cameras(f, lambda c: c["000005"]["smpl_to_world"].__imul__(np.diag([2.0] * 4))),
        "one scene has one scale",
    )

    def turned_rows(folder: Path) -> None:
        rows = np.load(folder / "poses_bounds.npy")
        np.save(folder / "poses_bounds.npy", rows[::-1])

    broken("rows", turned_rows, "turn differently at .* frames")
    broken(
        "count",
        lambda f: np.save(f / "poses_bounds.npy", np.zeros((3, 17))),
        "one row for each image",
    )
    broken(
        "shape",
        lambda f: edit(
            f / "mesh_infos.pkl", lambda m: [e["tpose_joints"].__imul__(1.3) for e in m.values()]
        ),
        "zero-pose joints are not this model's",
    )
