"""reader:hold: the built-in clip there and back, and the traps of HOLD's build folders."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import hold
from layouts.common import save_mask
from same import same_cameras

from hoigs.core.errors import ClipError
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.clip import Clip
from hoigs.plugins.readers.zoo.hold import HoldReader, decomposed

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("tensor", [False, True])
def test_round_trip(builtin: Clip, tmp_path: Path, tensor: bool) -> None:
    """Cameras, pictures, masks and the object's poses, in HOLD's world (OpenGL axes, metres). The
    layout cannot hold a body (only MANO hands), depth, colours or points of the scene."""
    folder = hold.write(builtin, tmp_path, tensor=tensor)
    reader = HoldReader()
    assert reader.matches(folder) and reader.matches(folder / "build")
    assert not reader.matches(tmp_path)
    clip = pickle.loads(pickle.dumps(reader.read(folder)))
    assert clip.kinds == {"hand_right": "human", "object": "object"} and clip.bodies == {}
    turned = torch.block_diag(FLIP, torch.ones(1, 1))
    same_cameras(
        clip.cameras,
        [type(c)(c.K, c.world_to_camera @ turned, c.width, c.height) for c in builtin.cameras],
        2e-6,
    )
    for i in range(len(clip)):
        want = builtin[i].masks
        assert clip[i].image.equal(builtin[i].image)
        assert clip[i].masks["object"].equal(want["object"])
        assert clip[i].masks["hand_right"].equal(want["human"] & ~want["object"])
    got, truth = clip.objects["object"], builtin.objects["object"]
    shown = torch.einsum("fab,pb->fpa", got.rotations, got.points) + got.translations[:, None]
    placed = torch.einsum("fab,pb->fpa", truth.rotations, truth.points)
    placed = (placed + truth.translations[:, None]) @ FLIP
    torch.testing.assert_close(shown, placed, atol=1e-5, rtol=0)
    assert "MANO" in clip.provenance["poses of hand_right"]
    assert HoldReader().read(folder / "build").name == "hold_box_itw"


def test_the_sphere_of_scale_mat_does_not_shrink_the_world(builtin: Clip, tmp_path: Path) -> None:
    a = HoldReader().read(hold.write(builtin, tmp_path / "a", shrink=0.3))
    b = HoldReader().read(hold.write(builtin, tmp_path / "b", shrink=7.0))
    same_cameras(a.cameras, b.cameras)


def test_projections_of_any_scale_and_sign() -> None:
    K = np.array([[900.0, 0, 310], [0, 880, 250], [0, 0, 1]])
    R = axis_angle_to_matrices(torch.tensor([0.4, -1.2, 2.0]).double()).numpy()
    for factor in (1.0, -2.0, 0.01):
        got, w2c = decomposed(factor * K @ np.c_[R, [0.1, 0.2, 3.0]], "here")
        np.testing.assert_allclose(got, K, atol=1e-9)
        np.testing.assert_allclose(w2c[:3], np.c_[R, [0.1, 0.2, 3.0]], atol=1e-12)
    skewed = K.copy()
    skewed[0, 1] = 40
    with pytest.raises(ClipError, match="here: pixels are skewed by 40"):
        decomposed(skewed @ np.c_[R, np.zeros(3)], "here")
    with pytest.raises(ClipError, match="no inverse"):
        decomposed(np.zeros((3, 4)), "here")


def test_a_segmenters_own_masks_are_refused(builtin: Clip, tmp_path: Path) -> None:
    folder = hold.write(builtin, tmp_path)
    save_mask(folder / "build/mask/0000.png", builtin[0].masks["object"])
    with pytest.raises(ClipError, match=r"has the values \[0, 255\].*segmenter's own"):
        HoldReader().read(folder)


def test_partial_and_wrong_folders(builtin: Clip, tmp_path: Path) -> None:
    folder = hold.write(builtin, tmp_path)
    for name in ("data.npy", "mask/0002.png", "mask/0005.png"):
        (folder / "build" / name).unlink()
    with pytest.raises(ClipError) as caught:
        HoldReader().read(folder)
    told = str(caught.value)
    assert "build/data.npy is absent" in told and "build_dataset.py" in told
    assert "build/mask/{0002,0005}.png (2 files) are absent" in told
    with pytest.raises(ClipError, match=r"data\.npy is absent(.|\n)*image/0000\.png is absent"):
        HoldReader().read(tmp_path)


def test_inconsistent_data_is_told(builtin: Clip, tmp_path: Path) -> None:
    folder = hold.write(builtin, tmp_path)
    path = folder / "build/data.npy"
    data = np.load(path, allow_pickle=True).item()
    poses = data["entities"]["object"]["object_poses"]
    for change, message in (
        (
            lambda: data["entities"]["object"].update(object_poses=poses[:3]),
            r"expected .* \[8, 6\], got \[3, 6\]",
        ),
        (lambda: data["entities"]["object"].pop("norm_mat"), "lacks .'norm_mat'"),
        (lambda: data["cameras"].pop("world_mat_7"), "no world_mat_7 .1 of 8"),
        (lambda: data.pop("entities"), "expected a dictionary with cameras and entities"),
    ):
        change()
        np.save(path, data, allow_pickle=True)
        with pytest.raises(ClipError, match=message):
            HoldReader().read(folder)
