"""A clip folder that lacks files is refused, or read without them with allow_faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from test_clip_folder import write

from hoigs.core.clip_folder.check import usable_clip
from hoigs.core.errors import ClipError
from hoigs.core.system.npz import load_arrays
from hoigs.core.values.clip import Clip
from hoigs.metrics.regions import region_masks
from hoigs.plugins.readers.clip import ClipFolderReader


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "clip")
    return tmp_path / "clip"


def read(folder: Path) -> Clip:
    reader = ClipFolderReader()
    reader.allow_faults = True
    return reader.read(folder)


def spoil_depth(folder: Path, frame: int, value: float, rows: int = 2) -> None:
    path = folder / f"depth/{frame:05d}.npz"
    depth = load_arrays(path)["depth"].copy()
    depth[:rows] = value
    np.savez(path, depth=depth)


def faults(clip: Clip) -> list[str]:
    return [fault.kind for fault in clip.faults]


def test_a_whole_clip_has_no_faults(folder: Path) -> None:
    assert read(folder).faults == []
    assert usable_clip(folder)[1] == []


def test_a_refusal_says_how_to_go_on(folder: Path) -> None:
    (folder / "masks/ann/00003.png").unlink()
    with pytest.raises(ClipError, match="or continue without these: --allow-faults"):
        ClipFolderReader().read(folder)
    (folder / "points.npz").unlink()
    with pytest.raises(ClipError) as refused:
        ClipFolderReader().read(folder)
    assert "--allow-faults" not in str(refused.value), "that would not help"
    with pytest.raises(ClipError, match=r"points\.npz") as refused:
        read(folder)
    assert "masks" not in str(refused.value)


def test_absent_masks(folder: Path) -> None:
    for frame in (3, 4):
        (folder / f"masks/ann/{frame:05d}.png").unlink()
    (folder / "masks/ann/00006.png").write_bytes(b"no png")
    clip = read(folder)
    assert faults(clip) == ["missing-masks", "missing-masks"]
    absent, broken = clip.faults
    assert absent.frames == (3, 4) and "masks/ann/00003-00004.png (2 of 8) are absent" in str(
        absent
    )
    assert "masks come from" in absent.do and "not compared with the video there" in absent.do
    assert broken.frames == (6,) and "cannot be read" in str(broken)
    assert clip[3].unknown == {"ann"} and not clip[3].masks["ann"].any()
    assert clip[2].unknown == frozenset() and clip[2].masks["ann"].any()
    small = clip.resized(clip.cameras[0].width // 2)
    assert small[3].unknown == {"ann"} and small[2].unknown == frozenset()
    regions = region_masks(clip[3], clip.kinds, 2)
    assert regions["full"].all()
    assert not any(regions[name].any() for name in ("human", "human_object", "background"))


def test_depth_that_is_no_depth(folder: Path) -> None:
    spoil_depth(folder, 1, float("nan"))
    spoil_depth(folder, 2, float("inf"))
    spoil_depth(folder, 5, -1.0)
    (folder / "depth/00007.npz").unlink()
    clip = read(folder)
    assert sorted(faults(clip)) == ["missing-depth", "nan-depth"]
    (nan,) = (f for f in clip.faults if f.kind == "nan-depth")
    assert nan.frames == (1, 2, 5) and "write 0 where depth is unknown" in nan.do
    share = 100 * 2 / clip.cameras[0].height
    assert f"{share:.1f} %" in nan.what
    for frame in (1, 2, 5):
        depth = clip[frame].depth
        assert depth is not None and torch.isfinite(depth).all() and (depth >= 0).all()
        assert (depth[:2] == 0).all() and (depth[2:] > 0).any()
    assert clip[7].depth is None


def test_absent_images_leave_the_split(folder: Path) -> None:
    clip = ClipFolderReader().read(folder)
    gone = [clip.split["train"][1], clip.split["train"][2]]
    for frame in gone:
        next((folder / "images").glob(f"{frame:05d}.*")).unlink()
    clip = read(folder)
    assert faults(clip) == ["missing-frames"] and clip.faults[0].frames == tuple(gone)
    assert not set(gone) & set(clip.split["train"]) and len(clip.split["train"]) > 0
    frame = clip[gone[0]]
    assert frame.ignored is not None and frame.ignored.all(), "nothing is shown, or scored"
    for path in (folder / "images").iterdir():
        path.unlink()
    with pytest.raises(ClipError, match="no image of split"):
        read(folder)
