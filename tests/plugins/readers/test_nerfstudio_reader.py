"""reader:nerfstudio: the built-in clip there and back, and the traps of transforms.json."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from layouts import nerfstudio
from PIL import Image
from same import same_cameras

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.nerfstudio import NerfstudioReader


def edit(folder: Path, change: Any) -> None:
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_round_trip(builtin: Clip, tmp_path: Path, scale: float) -> None:
    """All but entities: the layout's masks say only what to ignore. Metres come back from a
    scaled file; depth has millimetres."""
    nerfstudio.write(builtin, tmp_path, scale=scale)
    reader = NerfstudioReader()
    assert reader.matches(tmp_path) and not reader.matches(tmp_path / "images")
    clip = reader.read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    assert clip.split == {k: list(v) for k, v in builtin.split.items()}
    for mine, theirs in zip(clip, builtin, strict=True):
        assert mine.image.equal(theirs.image) and mine.moment.time == theirs.moment.time
        moving = torch.stack(list(theirs.masks.values())).any(0)
        assert mine.ignored is not None and mine.ignored.equal(moving)
        assert mine.depth is not None and theirs.depth is not None
        assert (mine.depth - theirs.depth).abs().max() < 0.00051
    assert clip.kinds == {} and clip.depth_kind == "metric"
    assert torch.allclose(clip.points, builtin.points)


def test_without_the_optional(builtin: Clip, tmp_path: Path) -> None:
    nerfstudio.write(builtin, tmp_path, extras=False, times=False, lists=False, ply=False)
    clip = NerfstudioReader(NerfstudioReader.Config(points=100)).read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    assert [m.time for m in clip.moments] == [m.time for m in builtin.moments]
    assert clip[0].ignored is None and clip[0].depth is None and clip.depth_kind == "none"
    assert len(clip.points) == 100 and "at random" in clip.provenance["points"]
    assert clip.split["test"] and clip.split["train"]


def test_masks_in_alpha_and_paths_of_windows(builtin: Clip, tmp_path: Path) -> None:
    nerfstudio.write(builtin, tmp_path)
    want = NerfstudioReader().read(tmp_path)

    def change(content: Any) -> None:
        for frame in content["frames"]:
            path = tmp_path / frame["mask_path"]
            with Image.open(path) as image:
                alpha = image.convert("L")
            white = Image.new("L", alpha.size, 255)
            Image.merge("RGBA", (white, white, white, alpha)).save(path)
            for key in ("file_path", "mask_path", "depth_file_path"):
                frame[key] = frame[key].replace("/", "\\")
        for key in ("train_filenames", "val_filenames"):
            content[key] = [name.replace("/", "\\") for name in content[key]]

    edit(tmp_path, change)
    clip = NerfstudioReader().read(tmp_path)
    assert clip.split == want.split
    for mine, theirs in zip(clip, want, strict=True):
        assert mine.image.equal(theirs.image) and mine.ignored is not None
        assert mine.ignored.any() and mine.ignored.equal(theirs.ignored)


def test_distortion_is_taken_out_of_all(builtin: Clip, tmp_path: Path) -> None:
    """And the principal point stays where it is."""
    bent = {"fl_x": 18.0, "fl_y": 19.0, "cx": 14.0, "cy": 17.5, "k1": -0.2, "k2": 0.02, "p1": 0.001}
    nerfstudio.write(builtin, tmp_path, lens=bent)
    clip = NerfstudioReader().read(tmp_path)
    assert clip.cameras[0].K.tolist() == [[18, 0, 14], [0, 19, 17.5], [0, 0, 1]]
    flat = Lens("OPENCV", (18.0, 19.0, 14.0, 17.5, -0.2, 0.02, 0.001, 0.0), 32, 32).undistortion()
    for mine, theirs in zip(clip, builtin):
        assert mine.image.equal(torch.from_numpy(flat.image(theirs.image.numpy())))
        assert not mine.image.equal(theirs.image)
        moving = torch.stack(list(theirs.masks.values())).any(0)
        want = torch.from_numpy(flat.mask(moving.numpy()))
        if flat.outside is not None:
            want = want | torch.from_numpy(flat.outside)
        assert mine.ignored is not None and mine.ignored.equal(want)
        assert mine.depth is not None and theirs.depth is not None
        depth = torch.from_numpy(flat.depth(theirs.depth.numpy()))
        assert (mine.depth - depth).abs().max() < 0.00051


def test_fisheyes_and_other_models(builtin: Clip, tmp_path: Path) -> None:
    nerfstudio.write(builtin, tmp_path, lens={"camera_model": "OPENCV_FISHEYE", "k1": 0.1})
    store: Any = NerfstudioReader().read(tmp_path).store
    assert store.lenses[0].model == "OPENCV_FISHEYE" and store.lenses[0].params[4] == 0.1
    edit(tmp_path, lambda c: c.update(camera_model="EQUIRECTANGULAR"))
    with pytest.raises(ClipError, match="camera_model EQUIRECTANGULAR has no pinhole image"):
        NerfstudioReader().read(tmp_path)
    edit(tmp_path, lambda c: c.update(camera_model="OPENCV", k4=0.2))
    with pytest.raises(ClipError, match=r"k4 = 0\.2 on a OPENCV lens"):
        NerfstudioReader().read(tmp_path)


def test_intrinsics_of_a_frame_go_first(builtin: Clip, tmp_path: Path) -> None:
    nerfstudio.write(builtin, tmp_path)
    edit(tmp_path, lambda c: c["frames"][0].update(fl_x=50.0))  # the last by name
    clip = NerfstudioReader().read(tmp_path)
    assert clip.cameras[7].K[0, 0] == 50 and clip.cameras[0].K[0, 0] == builtin.cameras[0].K[0, 0]


def test_smaller_images(builtin: Clip, tmp_path: Path) -> None:
    nerfstudio.write(builtin, tmp_path)
    (tmp_path / "images_2").mkdir()
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as image:
            image.resize((16, 16)).save(tmp_path / "images_2" / path.name)
    clip = NerfstudioReader(NerfstudioReader.Config(factor=2)).read(tmp_path)
    want = builtin.cameras[0].K * torch.tensor([[0.5], [0.5], [1.0]])
    assert torch.allclose(clip.cameras[0].K, want)
    frame = clip[0]
    assert frame.depth is not None and frame.depth.shape == frame.image.shape[:2] == (16, 16)


def test_a_partial_folder_is_told_in_one_message(builtin: Clip, tmp_path: Path) -> None:
    nerfstudio.write(builtin, tmp_path)
    shutil.rmtree(tmp_path / "masks")
    (tmp_path / "images/frame_3.png").unlink()
    (tmp_path / "sparse_pc.ply").unlink()
    (tmp_path / "depth/frame_8.png").unlink()
    edit(tmp_path, lambda c: c["train_filenames"].append("images/frame_99.png"))
    with pytest.raises(ClipError) as caught:
        NerfstudioReader().read(tmp_path)
    message = str(caught.value)
    for part in (
        "images/frame_3.png is absent: `ns-process-data",
        "masks/frame_{1-8}.png (8 files) are absent: your segmenter",
        "depth/frame_8.png is absent: your capture app",
        "sparse_pc.ply is absent",
        "train_filenames lists images/frame_99.png: not in frames",
    ):
        assert part in message


def test_inconsistent_files(builtin: Clip, tmp_path: Path) -> None:
    with pytest.raises(ClipError, match=r"transforms\.json is absent: `ns-process-data"):
        NerfstudioReader().read(tmp_path)
    nerfstudio.write(builtin, tmp_path)
    edit(tmp_path, lambda c: c["frames"][0].pop("time"))
    with pytest.raises(ClipError, match='7 of 8 frames have a "time"; all or none'):
        NerfstudioReader().read(tmp_path)
    nerfstudio.write(builtin, tmp_path, lens={"fl_x": None, "fl_y": None})
    with pytest.raises(ClipError, match=r"frames\.7: no focal length"):
        NerfstudioReader().read(tmp_path)
