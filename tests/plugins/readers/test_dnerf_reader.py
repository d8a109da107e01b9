"""reader:dnerf: the built-in clip there and back, and the traps of Blender scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from layouts import dnerf
from layouts.common import save_ply
from same import same_cameras

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip
from hoigs.plugins.readers.zoo.dnerf import DnerfReader


def edit(path: Path, change: Any) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_round_trip(builtin: Clip, tmp_path: Path) -> None:
    """Cameras, pictures and times; the layout has no masks, poses, depth or points."""
    dnerf.write(builtin, tmp_path)
    reader = DnerfReader()
    assert reader.matches(tmp_path) and not reader.matches(tmp_path / "train")
    clip = reader.read(tmp_path)
    train, test = builtin.split["train"], builtin.split["test"]
    order = [*train, *test, *test[:1]]
    same_cameras(clip.cameras, [builtin.cameras[i] for i in order])
    assert clip.split == {"train": list(range(6)), "test": [6, 7], "val": [8]}
    for i, k in enumerate(order):
        assert clip[i].image.equal(builtin[k].image)
        assert clip.moments[i].time == builtin.moments[k].time
    assert clip.kinds == {} and clip[0].masks == {} and clip[0].depth is None
    assert clip.num_frames == len(train), "test times lie between, on the training grid"


def test_opengl_axes_are_turned(tmp_path: Path, builtin: Clip) -> None:
    """A camera at z = 4 that looks at the origin, y up: Blender's identity, moved back."""
    dnerf.write(builtin, tmp_path, val=False)

    def place(content: Any) -> None:
        pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
        content["frames"][0]["transform_matrix"] = pose

    edit(tmp_path / "transforms_train.json", place)
    camera = DnerfReader().read(tmp_path).cameras[0]
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]])
    pixels, depth = camera.project(points)
    assert depth.tolist() == [4, 4, 4]
    assert pixels[0].tolist() == [16, 16], "the middle between pixels 15 and 16"
    assert pixels[1, 0] > 16 and pixels[2, 1] < 16, "x to the right, y up the image"


def test_transparency(builtin: Clip, tmp_path: Path) -> None:
    dnerf.write(builtin, tmp_path, alpha=True)
    shown = torch.stack(list(builtin[builtin.split["train"][2]].masks.values())).any(0)
    assert shown.any() and not shown.all()
    black, white = (
        DnerfReader(DnerfReader.Config(background=b)).read(tmp_path)[2].image  # type: ignore[arg-type]
        for b in ("black", "white")
    )
    assert not black[~shown].any() and (white[~shown] == 255).all()
    assert black[shown].equal(white[shown])


def test_times_beyond_1_are_divided_by_the_largest(builtin: Clip, tmp_path: Path) -> None:
    dnerf.write(builtin, tmp_path, val=False, seconds=3.5)
    clip, train = DnerfReader().read(tmp_path), builtin.split["train"]
    want = [builtin.moments[i].time for i in (*train, *builtin.split["test"])]
    assert [m.time for m in clip.moments] == pytest.approx(want)


def test_images_keep_their_size(builtin: Clip, tmp_path: Path) -> None:
    """Not 800x800, and fl_x with w serves as well as an angle, scaled to the picture."""
    dnerf.write(builtin, tmp_path, val=False)

    def in_pixels(content: Any) -> None:
        del content["camera_angle_x"]
        content |= {"fl_x": 88.0, "w": 64, "h": 64, "cx": 30.0, "cy": 34.0}

    edit(tmp_path / "transforms_train.json", in_pixels)
    camera = DnerfReader().read(tmp_path).cameras[0]
    assert (camera.width, camera.height) == (32, 32)
    assert torch.allclose(camera.K[:2], torch.tensor([[44.0, 0, 15], [0, 44, 17]]))


def test_points_of_a_file_or_at_random(builtin: Clip, tmp_path: Path) -> None:
    dnerf.write(builtin, tmp_path)
    clip = DnerfReader(DnerfReader.Config(points=300)).read(tmp_path)
    assert clip.points.shape == (300, 3) and 1.2 < float(clip.points.abs().max()) <= 1.3
    assert clip.points.equal(DnerfReader(DnerfReader.Config(points=300)).read(tmp_path).points)
    assert "at random" in clip.provenance["points"]
    save_ply(tmp_path / "fused.ply", builtin.points, builtin.point_colors, floats=True)
    clip = DnerfReader().read(tmp_path)
    assert torch.allclose(clip.points, builtin.points)
    assert (clip.point_colors - builtin.point_colors).abs().max() < 0.51 / 255


def test_a_partial_folder_is_told_in_one_message(builtin: Clip, tmp_path: Path) -> None:
    dnerf.write(builtin, tmp_path)
    for number in (1, 2):
        (tmp_path / f"train/r_{number:03d}.png").unlink()
    (tmp_path / "test/r_001.png").unlink()
    edit(tmp_path / "transforms_train.json", lambda c: c["frames"][3].pop("time"))
    with pytest.raises(ClipError) as caught:
        DnerfReader().read(tmp_path)
    message = str(caught.value)
    assert "train/r_{001-002}.png (2 files) are absent: D-NeRF's data.zip" in message
    assert "test/r_001.png is absent" in message
    assert 'transforms_train.json: frames.3 has no "time" (1 frames of all)' in message


def test_wrong_folders_and_files(builtin: Clip, tmp_path: Path) -> None:
    with pytest.raises(ClipError) as caught:
        DnerfReader().read(tmp_path)
    assert "transforms_train.json is absent" in str(caught.value)
    assert "transforms_test.json is absent" in str(caught.value)
    dnerf.write(builtin, tmp_path)
    edit(tmp_path / "transforms_test.json", lambda c: c["frames"][1].pop("transform_matrix"))
    with pytest.raises(ClipError, match=r"frames\.1\.transform_matrix: Field required"):
        DnerfReader().read(tmp_path)
    (tmp_path / "transforms_test.json").write_text("{")
    with pytest.raises(ClipError, match=r"transforms_test\.json: damaged, not readable as JSON"):
        DnerfReader().read(tmp_path)


def test_scaled_cameras_are_refused(builtin: Clip, tmp_path: Path) -> None:
    dnerf.write(builtin, tmp_path, val=False)

    def scale(content: Any) -> None:
        rows = content["frames"][2]["transform_matrix"]
        content["frames"][2]["transform_matrix"] = [[2 * v for v in row] for row in rows]

    edit(tmp_path / "transforms_train.json", scale)
    with pytest.raises(ClipError, match=r"transforms_train\.json: frames\.2: the rotation is not"):
        DnerfReader().read(tmp_path)
