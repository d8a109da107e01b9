"""reader:colmap: the built-in clip there and back, and what goes wrong in such folders."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import colmap
from PIL import Image
from same import same_cameras

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.colmap import ColmapConfig, ColmapReader


def renamed(folder: Path, name: Callable[[int], str]) -> None:
    """Images, masks and a text model with other names."""
    path = folder / "sparse/0/images.txt"
    text = path.read_text()
    for i in range(8):
        text = text.replace(f" frame_{i + 1}.png", f" {name(i)}")
        for place in ("images", "masks/human", "masks/object"):
            if (old := folder / place / f"frame_{i + 1}.png").is_file():
                new = folder / place / name(i).replace("\\", "/")
                new.parent.mkdir(exist_ok=True)
                shutil.move(old, new)
    path.write_text(text)


@pytest.mark.parametrize(
    ("binary", "place"), [(False, "sparse/0"), (True, "sparse/0"), (True, "sparse")]
)
def test_round_trip(builtin: Clip, tmp_path: Path, binary: bool, place: str) -> None:
    """All but poses and object tracks, which a COLMAP folder cannot hold."""
    colmap.write(builtin, tmp_path, binary=binary, place=place)
    reader = ColmapReader()
    assert reader.matches(tmp_path) and not reader.matches(tmp_path / "images")
    clip = reader.read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    for mine, theirs in zip(clip, builtin, strict=True):
        assert mine.image.equal(theirs.image) and mine.moment.time == theirs.moment.time
        assert all(mine.masks[n].equal(theirs.masks[n]) for n in ("human", "object"))
    assert clip.kinds == builtin.kinds and not clip.bodies and not clip.objects
    same = (clip.points[:, None] - builtin.points[None]).norm(dim=-1).min(1)
    assert len(clip.points) == len(builtin.points)
    assert float(same.values.max()) < 1e-5
    assert (clip.point_colors - builtin.point_colors[same.indices]).abs().max() < 0.51 / 255
    assert clip.split["test"] and not set(clip.split["test"]) & set(clip.split["train"])


def test_the_lens_is_taken_out_and_its_centre_kept(builtin: Clip, tmp_path: Path) -> None:
    params = (18.0, 19.0, 14.0, 17.5, -0.2, 0.02, 0.001, 0.0)  # cx, cy away from the middle
    colmap.write(builtin, tmp_path, lens=("OPENCV", params))
    clip = ColmapReader().read(tmp_path)
    want = torch.tensor([[18.0, 0, 14.0], [0, 19.0, 17.5], [0, 0, 1]])
    assert clip.cameras[0].K.equal(want)
    assert not clip[0].image.equal(builtin[0].image)
    moved = 0
    for mine, bent in zip(clip, builtin):
        want = Lens("OPENCV", params, 32, 32).undistortion().mask(bent.masks["human"].numpy())
        assert mine.masks["human"].equal(torch.from_numpy(want)) and mine.masks["human"].any()
        moved += not mine.masks["human"].equal(bent.masks["human"])
    assert moved >= 2


def test_smaller_images_shrink_the_intrinsics(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path, masks=False)
    (tmp_path / "images_2").mkdir()
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as image:
            image.resize((16, 16)).save(tmp_path / "images_2" / path.name)
    clip = ColmapReader(ColmapReader.Config(factor=2)).read(tmp_path)
    assert clip[0].image.shape == (16, 16, 3)
    want = builtin.cameras[0].K * torch.tensor([[0.5], [0.5], [1.0]])
    assert torch.allclose(clip.cameras[0].K, want)
    with pytest.raises(ClipError, match=r"images_4/ is absent: images at 1/4 size"):
        ColmapReader(ColmapReader.Config(factor=4)).read(tmp_path)


def test_frames_are_in_the_order_of_their_names(builtin: Clip, tmp_path: Path) -> None:
    """Not the file's; frame_10 comes after frame_9; a frame without a pose takes its time."""
    colmap.write(builtin, tmp_path, masks=False, order=(5, 3, 7, 0, 1, 6, 2, 4))
    clip = ColmapReader().read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    for number in (9, 10):  # never registered
        shutil.copy(tmp_path / "images/frame_8.png", tmp_path / f"images/frame_{number}.png")
    longer = ColmapReader().read(tmp_path)
    assert [m.index for m in longer.moments] == list(range(8))
    assert longer.moments[7].time == pytest.approx(7 / 9)


def test_images_in_folders_of_their_own(builtin: Clip, tmp_path: Path) -> None:
    """One folder a camera, with the same names in both; masks likewise."""
    colmap.write(builtin, tmp_path)
    renamed(tmp_path, lambda i: f"cam{i // 4}/{i % 4}.png")
    clip = ColmapReader().read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    for mine, theirs in zip(clip, builtin, strict=True):
        assert mine.image.equal(theirs.image)
        assert mine.masks["human"].equal(theirs.masks["human"])


@pytest.mark.parametrize("name", ["my frame {:02d}.png", "a room\\{:02d}.png"])
def test_names_with_spaces_and_of_windows(builtin: Clip, tmp_path: Path, name: str) -> None:
    colmap.write(builtin, tmp_path)
    renamed(tmp_path, name.format)
    clip = ColmapReader().read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    for mine, theirs in zip(clip, builtin, strict=True):
        assert mine.image.equal(theirs.image) and mine.masks["human"].equal(theirs.masks["human"])


@pytest.mark.parametrize(
    ("name", "instants"),
    [
        (lambda i: f"cam{i // 4}/{i % 4}.png", [0, 1, 2, 3, 0, 1, 2, 3]),
        (lambda i: f"cam{i // 4}/c{i // 4}_{i % 4:03d}.png", [0, 1, 2, 3, 0, 1, 2, 3]),
        (lambda i: f"cam{i // 5}/{i % 5 + 2 * (i // 5)}.png", [0, 1, 2, 3, 4, 2, 3, 4]),
        (lambda i: f"cam{i // 4}/{'abcd'[i % 4]}.png", [0, 1, 2, 3, 0, 1, 2, 3]),
        (lambda i: f"part{i // 4}/{i}.png", [0, 1, 2, 3, 4, 5, 6, 7]),
    ],
)
def test_cameras_that_run_at_once(
    builtin: Clip, tmp_path: Path, name: Callable[[int], str], instants: list[int]
) -> None:
    colmap.write(builtin, tmp_path, masks=False)
    renamed(tmp_path, name)
    moments = ColmapReader().read(tmp_path).moments
    assert [m.index for m in moments] == instants
    assert [m.time for m in moments] == pytest.approx([i / max(instants) for i in instants])


def test_one_camera_of_several(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path)
    renamed(tmp_path, lambda i: f"cam{i // 4}/{i % 4}.png")
    clip = ColmapReader(ColmapReader.Config(camera="cam1")).read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras[4:])
    assert [m.time for m in clip.moments] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    with pytest.raises(ClipError, match=r'cam2.*"cam[01]"'):
        ColmapReader(ColmapReader.Config(camera="cam2")).read(tmp_path)


@pytest.mark.parametrize("binary", [False, True])
def test_the_largest_model_is_taken_and_said(builtin: Clip, tmp_path: Path, binary: bool) -> None:
    colmap.write(builtin, tmp_path, binary=binary, place="sparse/1")
    colmap.write(builtin, tmp_path, binary=binary, place="sparse/0", order=(0, 1, 2))
    with pytest.warns(UserWarning, match=r"sparse/0 \(3 images\), sparse/1 \(8 images\)"):
        clip = ColmapReader().read(tmp_path)
    assert len(clip) == 8 and clip.provenance["cameras"].startswith("sparse/1")
    assert len(ColmapReader(ColmapReader.Config(model="sparse/0")).read(tmp_path)) == 3


def test_a_model_without_points(builtin: Clip, tmp_path: Path) -> None:
    """Points lie in front of the cameras, and are said to be random."""
    colmap.write(builtin, tmp_path)
    path = tmp_path / "sparse/0/points3D.txt"
    path.write_text(path.read_text().splitlines()[0] + "\n")
    clip = ColmapReader(ColmapReader.Config(points=100)).read(tmp_path)
    assert 100 <= len(clip.points) < 110 and clip.points.isfinite().all()
    assert "random" in clip.provenance["points"]
    seen = [camera.project(clip.points)[1].min() > 0 for camera in clip.cameras]
    assert any(seen)


@pytest.mark.parametrize(
    "model", [("EQUIRECTANGULAR", (32.0, 32.0)), ("LIGHT_FIELD", (32.0, 32.0))]
)
def test_a_lens_without_a_pinhole_image_is_named(
    builtin: Clip, tmp_path: Path, model: tuple[str, tuple[float, ...]]
) -> None:
    colmap.write(builtin, tmp_path, lens=model)
    with pytest.raises(ClipError, match=rf"sparse/0.*{model[0]}"):
        ColmapReader().read(tmp_path)


def test_a_partial_folder_is_told_in_one_message(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path)
    (tmp_path / "sparse/0/points3D.txt").unlink()
    shutil.move(tmp_path / "images", tmp_path / "elsewhere")
    with pytest.raises(ClipError) as caught:
        ColmapReader().read(tmp_path)
    message = str(caught.value)
    assert "images/ is absent: the video's frames" in message
    assert "sparse/0/points3D.txt is absent: COLMAP makes" in message
    assert "cameras.txt" not in message


def test_absent_images_and_masks_are_named(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path)
    for name in ("frame_2", "frame_3"):
        (tmp_path / f"images/{name}.png").unlink()
    (tmp_path / "masks/human/frame_5.png").unlink()
    with pytest.raises(ClipError) as caught:
        ColmapReader().read(tmp_path)
    message = str(caught.value)
    assert "images/frame_{2-3}.png (2 files) are absent" in message
    assert "masks/human/frame_5.png is absent: your segmenter makes" in message


def test_wrong_folders(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="is not a folder"):
        ColmapReader().read(tmp_path / "no")
    with pytest.raises(ClipError, match=r"sparse/0/cameras\.bin or sparse/0/cameras\.txt is abs"):
        ColmapReader().read(tmp_path)
    assert not ColmapReader().matches(tmp_path)


def test_a_damaged_model_is_named(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path, binary=True)
    path = tmp_path / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ClipError, match=r"sparse/0/images\.bin is not a readable COLMAP file"):
        ColmapReader().read(tmp_path)


def test_images_of_another_shape_are_refused(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path, masks=False)
    Image.fromarray(np.zeros((32, 40, 3), np.uint8)).save(tmp_path / "images/frame_4.png")
    with pytest.raises(
        ClipError, match=r"frame_4\.png is 40x32, its camera 32x32: different aspect"
    ):
        ColmapReader().read(tmp_path)


def test_every_eighth_as_3dgs_splits(builtin: Clip, tmp_path: Path) -> None:
    colmap.write(builtin, tmp_path, masks=False)
    reader = ColmapReader(ColmapReader.Config(**ColmapConfig(test_every=3).model_dump()))
    assert reader.read(tmp_path).split == {"train": [1, 2, 4, 5, 7], "test": [0, 3, 6]}
