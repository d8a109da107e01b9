"""reader:neuman: the built-in clip there and back, and the traps of NeuMan's scenes."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from layouts import neuman
from layouts.anny_models import write_model
from layouts.changed import without_fingers
from layouts.common import save_image
from same import same_cameras, same_poses

from hoigs.core.errors import ClipError
from hoigs.core.registry.registry import default_registry
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.zoo.neuman import NeumanReader

joblib = pytest.importorskip("joblib", reason="pip install joblib: NeuMan's files are its")


@pytest.fixture(scope="module")
def body() -> AnnyBody:
    return AnnyBody()


@pytest.fixture(scope="module")
def smpl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("models") / "SMPL_NEUTRAL.npz", "smpl")


@pytest.fixture(scope="module")
def source(builtin: Clip) -> Clip:
    """SMPL has no fingers."""
    return without_fingers(builtin)


def edit_alignments(folder: Path, change: Any) -> None:
    table = np.load(folder / "alignments.npy", allow_pickle=True).item()
    change(table)
    np.save(folder / "alignments.npy", np.array(table, dtype=object))


def test_round_trip(source: Clip, body: AnnyBody, smpl: Path, tmp_path: Path) -> None:
    """Metres come back from COLMAP's unit, SMPL poses from spaces of their own; the layout has no
    fingers, no objects and no masks of them."""
    neuman.write(source, tmp_path, body)
    reader = NeumanReader(NeumanReader.Config(smpl=smpl))
    assert reader.matches(tmp_path) and not reader.matches(tmp_path / "sparse")
    clip = reader.read(tmp_path)
    same_cameras(clip.cameras, source.cameras)
    same_poses(clip.bodies["human"].poses, source.bodies["human"].poses)
    assert clip.bodies["human"].model == "body:smpl" and clip.bodies["human"].gender == "neutral"
    for mine, theirs in zip(clip, source, strict=True):
        assert mine.image.equal(theirs.image) and mine.moment.time == theirs.moment.time
        assert mine.masks["human"].equal(theirs.masks["human"])
        assert mine.depth is not None and theirs.depth is not None
        assert torch.allclose(mine.depth, theirs.depth, atol=1e-5)
        placed = mine.moment.poses["human"].transl - theirs.moment.poses["human"].transl
        assert float(placed.abs().max()) < 1e-5
    nearest = (clip.points[:, None] - source.points[None]).norm(dim=-1).min(1).values
    assert float(nearest.max()) < 1e-5 and len(clip.points) == len(source.points)
    test = source.split["test"]
    assert clip.split == {"train": list(source.split["train"]), "test": test[:1], "val": test[1:]}
    assert clip.depth_kind == "metric" and clip.kinds == {"human": "human"}


def test_a_body_of_another_scale_keeps_its_size_and_look(
    source: Clip, body: AnnyBody, smpl: Path, tmp_path: Path
) -> None:
    """Monocular scales jitter; they cannot be seen from the camera of that frame."""
    neuman.write(source, tmp_path, body, scales=[1, 1, 1, 1, 1, 1.25, 0.8, 1])
    clip = NeumanReader(NeumanReader.Config(smpl=smpl)).read(tmp_path)
    same_poses(clip.bodies["human"].poses, source.bodies["human"].poses)
    assert "45.0 %" in clip.provenance["body scale"]


def test_smpl_rows_go_by_the_number_in_the_name(
    source: Clip, body: AnnyBody, smpl: Path, tmp_path: Path
) -> None:
    """COLMAP lost a frame, and lists the others in another order."""
    neuman.write(source, tmp_path, body, order=(6, 0, 3, 2, 7, 4, 1))
    (tmp_path / "train_split.txt").write_text("00000.png\n00007.png\n")
    clip = NeumanReader(NeumanReader.Config(smpl=smpl)).read(tmp_path)
    kept = [0, 1, 2, 3, 4, 6, 7]
    same_cameras(clip.cameras, [source.cameras[i] for i in kept])
    assert [m.index for m in clip.moments] == kept and clip.moments[5].time == 6 / 7
    want = source.bodies["human"].poses.map(lambda x: x[kept] if x.dim() > 1 else x)
    same_poses(clip.bodies["human"].poses, want)
    assert clip.split["train"] == [0, 6]


def test_without_a_model_all_but_poses_is_read(
    source: Clip, body: AnnyBody, tmp_path: Path
) -> None:
    neuman.write(source, tmp_path, body, depth=False)
    clip = NeumanReader().read(tmp_path)
    assert clip.kinds == {"human": "human"} and not clip.bodies
    assert "--reader-set smpl=" in clip.provenance["poses of human"]
    same_cameras(clip.cameras, source.cameras)
    assert clip.depth_kind == "none" and clip[0].depth is None


def test_the_lens_is_taken_out(source: Clip, body: AnnyBody, tmp_path: Path) -> None:
    lens = ("OPENCV", (18.0, 19.0, 14.0, 17.5, -0.2, 0.02, 0.001, 0.0))
    neuman.write(source, tmp_path, body, lens=lens)
    clip = NeumanReader().read(tmp_path)
    assert clip.cameras[0].K.tolist() == [[18, 0, 14], [0, 19, 17.5], [0, 0, 1]]
    assert not clip[0].image.equal(source[0].image)
    depth = clip[0].depth
    assert depth is not None and source[0].depth is not None and not depth.equal(source[0].depth)


def test_a_partial_folder_is_told_in_one_message(
    source: Clip, body: AnnyBody, tmp_path: Path
) -> None:
    neuman.write(source, tmp_path, body)
    for name in ("alignments.npy", "smpl_output_optimized.pkl", "val_split.txt"):
        (tmp_path / name).unlink()
    (tmp_path / "sparse/images.txt").unlink()
    (tmp_path / "segmentations/00003.png").unlink()
    with pytest.raises(ClipError) as caught:
        NeumanReader().read(tmp_path)
    message = str(caught.value)
    for part in (
        "alignments.npy is absent: it is in the authors' download (github.com/apple/ml-neuman); "
        "preprocess/export_alignment.py makes it",
        "smpl_output_optimized.pkl or smpl_output_romp.pkl is absent",
        "val_split.txt is absent: it is in the authors' download",
        "sparse/images.txt is absent",
        "segmentations/00003.png is absent",
    ):
        assert part in message
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(ClipError, match=r"images/00000\.png is absent: it is in the authors'"):
        NeumanReader().read(tmp_path)


def test_inconsistent_files(source: Clip, body: AnnyBody, smpl: Path, tmp_path: Path) -> None:
    neuman.write(source, tmp_path, body)
    edit_alignments(tmp_path, lambda t: t.update({"00002.png": -t["00002.png"]}))
    with pytest.raises(ClipError, match=r"alignments\.npy: 00002\.png is mirrored or flat"):
        NeumanReader().read(tmp_path)
    edit_alignments(tmp_path, lambda t: t.pop("00002.png"))
    with pytest.raises(ClipError, match=r"no entry for 1 of 8 images \(00002\.png\)"):
        NeumanReader().read(tmp_path)
    neuman.write(source, tmp_path, body)
    joblib.dump({1: {"pose": np.zeros((5, 72)), "betas": np.zeros((5, 10))}},
                tmp_path / "smpl_output_optimized.pkl")  # fmt: skip
    with pytest.raises(ClipError, match=r"pose has shape \[5, 72\]; expected rows up to 7"):
        NeumanReader(NeumanReader.Config(smpl=smpl)).read(tmp_path)
    (tmp_path / "train_split.txt").write_text("00099.png\n")
    with pytest.raises(ClipError, match=r"train_split\.txt names '00099\.png': not among"):
        NeumanReader().read(tmp_path)


def test_both_polarities_of_grey_are_foreground(
    source: Clip, body: AnnyBody, tmp_path: Path
) -> None:
    """White is the background in segmentations/, not the person."""
    neuman.write(source, tmp_path, body)
    grey = np.full((32, 32), 255, np.uint8)
    grey[10:20, 8:12], grey[10:20, 12:16] = 0, 60
    save_image(tmp_path / "segmentations/00000.png", grey)
    mask = NeumanReader().read(tmp_path)[0].masks["human"]
    assert mask[10:20, 8:16].all() and int(mask.sum()) == 80


def test_it_is_built_from_the_registry(smpl: Path) -> None:
    registry = default_registry()
    config = registry.config_class("reader:neuman")(smpl=smpl)
    reader = registry.get("reader:neuman")(config)
    assert isinstance(reader, NeumanReader) and reader.config.smpl == smpl
