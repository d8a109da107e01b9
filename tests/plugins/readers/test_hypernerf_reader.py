"""reader:hypernerf: the built-in clip there and back, and the traps of Nerfies captures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from layouts import hypernerf
from layouts.common import save_image, save_ply
from same import same_cameras

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip
from hoigs.plugins.readers.zoo.hypernerf import HypernerfReader


def edit(path: Path, change: Any) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_round_trip(builtin: Clip, tmp_path: Path) -> None:
    """Cameras, depth and points through scene.json's scale and centre, pictures, times and split;
    the layout has neither masks of entities nor poses nor colours of points."""
    hypernerf.write(builtin, tmp_path)
    reader = HypernerfReader()
    assert reader.matches(tmp_path) and not reader.matches(tmp_path / "camera")
    clip = reader.read(tmp_path)
    same_cameras(clip.cameras, builtin.cameras)
    assert clip.split == {k: list(v) for k, v in builtin.split.items()}
    for mine, theirs in zip(clip, builtin, strict=True):
        assert mine.image.equal(theirs.image)
        assert mine.moment.time == theirs.moment.time and mine.moment.index == theirs.moment.index
        assert mine.depth is not None and theirs.depth is not None
        assert torch.allclose(mine.depth, theirs.depth, atol=1e-5)
    assert clip.kinds == {} and clip.depth_kind == "metric"
    assert torch.allclose(clip.points, builtin.points, atol=1e-5)
    assert (clip.point_colors == 0.5).all()


def test_half_size_is_the_usual_one(builtin: Clip, tmp_path: Path) -> None:
    hypernerf.write(builtin, tmp_path, factors=(1, 2, 4))
    for factor, size in ((None, 16), (1, 32), (4, 8)):
        clip = HypernerfReader(HypernerfReader.Config(factor=factor)).read(tmp_path)
        frame = clip[0]
        assert frame.image.shape == (size, size, 3)
        assert torch.allclose(clip.cameras[0].K[:2] * 32 / size, builtin.cameras[0].K[:2])
        assert frame.depth is not None and frame.depth.shape == (size, size)


def test_interp_captures_split_by_order(builtin: Clip, tmp_path: Path) -> None:
    """Every 4th trains; the one two later tests, but for the last (4DGaussians)."""
    hypernerf.write(builtin, tmp_path, interp=True)
    assert HypernerfReader().read(tmp_path).split == {"train": [0, 4], "test": [2]}


def test_time_is_warp_id_not_order(builtin: Clip, tmp_path: Path) -> None:
    """Two cameras at a time, listed one camera after the other, and the second half first."""
    hypernerf.write(builtin, tmp_path)
    rows = {f"{i + 1:06d}": {"warp_id": (i + 2) % 4, "camera_id": i // 4} for i in range(8)}
    (tmp_path / "metadata.json").write_text(json.dumps(rows))
    clip = HypernerfReader().read(tmp_path)
    order = [2, 6, 3, 7, 0, 4, 1, 5]
    same_cameras(clip.cameras, [builtin.cameras[i] for i in order])
    assert [m.index for m in clip.moments] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert clip.moments[-1].time == 1 and clip.moments[2].time == pytest.approx(1 / 3)
    assert clip[0].image.equal(builtin[2].image)
    theirs = [order.index(i) for i in builtin.split["test"]]
    assert sorted(clip.split["test"]) == sorted(theirs)


@pytest.mark.parametrize("number", [-3, 10**30])
def test_a_time_has_a_number_of_its_own(builtin: Clip, tmp_path: Path, number: int) -> None:
    hypernerf.write(builtin, tmp_path)
    rows = json.loads((tmp_path / "metadata.json").read_text())
    next(iter(rows.values()))["warp_id"] = number
    (tmp_path / "metadata.json").write_text(json.dumps(rows))
    with pytest.raises(ClipError, match=r"metadata\.json[^\0]*warp_id: Input should be"):
        HypernerfReader().read(tmp_path)


def test_lens_and_principal_point(builtin: Clip, tmp_path: Path) -> None:
    bent = {"principal_point": [14.0, 18.0], "radial_distortion": [-0.2, 0.03, 0.01],
            "tangential_distortion": [0.002, -0.001], "pixel_aspect_ratio": 1.1,
            "focal_length": 20.0}  # fmt: skip
    hypernerf.write(builtin, tmp_path, camera=bent)
    clip = HypernerfReader().read(tmp_path)
    assert clip.cameras[0].K.tolist() == [[20, 0, 14], [0, 22, 18], [0, 0, 1]]
    store: Any = clip.store
    # OpenCV's order: k1 k2 p1 p2 k3
    assert store.lenses[0].params[4:9] == (-0.2, 0.03, 0.002, -0.001, 0.01)
    assert not clip[0].image.equal(builtin[0].image)
    edit(tmp_path / "camera/000004.json", lambda c: c.update(skew=0.5))
    with pytest.raises(ClipError, match=r"000004\.json: skew is 0\.5"):
        HypernerfReader().read(tmp_path)


def test_coloured_points_go_first(builtin: Clip, tmp_path: Path) -> None:
    hypernerf.write(builtin, tmp_path)
    points = torch.from_numpy(hypernerf.raw(builtin.points)).float()
    save_ply(tmp_path / "points3D_downsample2.ply", points, builtin.point_colors, floats=True)
    clip = HypernerfReader().read(tmp_path)
    assert torch.allclose(clip.points, builtin.points, atol=1e-5)
    assert (clip.point_colors - builtin.point_colors).abs().max() < 0.51 / 255


def test_what_no_training_frame_shows_is_ignored(builtin: Clip, tmp_path: Path) -> None:
    hypernerf.write(builtin, tmp_path)
    covisible = np.full((16, 16), 255, np.uint8)
    covisible[:, :5] = 0
    position = builtin.split["test"][0]
    save_image(tmp_path / f"covisible/2x/val/{position + 1:06d}.png", covisible)
    clip = HypernerfReader().read(tmp_path)
    ignored = clip[position].ignored
    assert ignored is not None and ignored[:, :10].all() and not ignored[:, 10:].any()
    assert clip[0].ignored is None or not clip[0].ignored.any()


def test_a_partial_folder_is_told_in_one_message(builtin: Clip, tmp_path: Path) -> None:
    hypernerf.write(builtin, tmp_path)
    (tmp_path / "points.npy").unlink()
    (tmp_path / "camera/000002.json").unlink()
    for number in (5, 6, 8):
        (tmp_path / f"rgb/1x/{number:06d}.png").unlink()
    edit(tmp_path / "metadata.json", lambda c: c.pop("000003"))
    with pytest.raises(ClipError) as caught:
        HypernerfReader().read(tmp_path)
    message = str(caught.value)
    for part in (
        "points.npy or points3D_downsample.ply or points3D_downsample2.ply is absent: the capt",
        "camera/000002.json is absent",
        "rgb/1x/{000005-000006,000008}.png (3 files) are absent",
        "metadata.json has no 000003 of dataset.json's ids",
    ):
        assert part in message


def test_points_that_are_no_real_numbers_are_refused(builtin: Clip, tmp_path: Path) -> None:
    """Of complex ones the imaginary part was dropped, with numpy's warning alone."""
    hypernerf.write(builtin, tmp_path)
    np.save(tmp_path / "points.npy", np.ones((5, 3), complex))
    with pytest.raises(ClipError, match=r"points\.npy cannot be read .*got complex128"):
        HypernerfReader().read(tmp_path)


def test_wrong_folders_and_files(builtin: Clip, tmp_path: Path) -> None:
    with pytest.raises(ClipError) as caught:
        HypernerfReader().read(tmp_path)
    for name in ("dataset.json", "metadata.json", "scene.json", "camera/"):
        assert f"{name} is absent" in str(caught.value)
    hypernerf.write(builtin, tmp_path)
    edit(tmp_path / "camera/000001.json", lambda c: c.pop("focal_length"))
    with pytest.raises(
        ClipError, match=r"000001\.json does not have .*\n  focal_length: Field req"
    ):
        HypernerfReader().read(tmp_path)
    shutil.rmtree(tmp_path / "rgb")
    with pytest.raises(ClipError, match=r"rgb/2x/\{000001-000008\}\.png \(8 files\) are absent"):
        HypernerfReader().read(tmp_path)
