"""reader:davis: the built-in clip there and back, with palette images and with folders."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from layouts import davis
from PIL import Image

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip
from hoigs.plugins.readers.zoo.davis import DavisReader


@pytest.mark.parametrize("folders", [False, True])
def test_round_trip(builtin: Clip, tmp_path: Path, folders: bool) -> None:
    """Pictures and masks. The layout cannot hold cameras, poses, tracks, depth or points: one
    camera stands at the origin."""
    folder = davis.write(builtin, tmp_path, folders=folders)
    reader = DavisReader(DavisReader.Config(people=[1], points=300))
    assert reader.matches(folder) and not reader.matches(tmp_path)
    clip = pickle.loads(pickle.dumps(reader.read(folder)))
    assert clip.kinds == {"human_1": "human", "object_2": "object"}
    for i in range(len(clip)):
        assert clip[i].image.equal(builtin[i].image)
        masks = builtin[i].masks
        human = masks["human"] if folders else masks["human"] & ~masks["object"]
        corner = torch.zeros_like(human)
        corner[0, 0] = not folders  # void
        assert clip[i].masks["human_1"].equal(human & ~corner)
        assert clip[i].masks["object_2"].equal(masks["object"] & ~corner)
        assert clip.cameras[i].world_to_camera.equal(torch.eye(4))
    assert clip.bodies == {} and clip.objects == {} and len(clip.points) == 304
    assert float(clip.cameras[0].K[0, 0]) == pytest.approx(1.2 * 32)
    assert "assumed" in clip.provenance["cameras"]
    assert float(DavisReader(DavisReader.Config(focal=50.0)).read(folder).cameras[0].K[1, 1]) == 50
    assert DavisReader().read(folder).kinds == {"object_1": "object", "object_2": "object"}
    with pytest.raises(ClipError, match=r"people=\[3\]: annotated objects are \[1, 2\]"):
        DavisReader(DavisReader.Config(people=[1, 3])).read(folder)


def test_an_object_may_enter_late(builtin: Clip, tmp_path: Path) -> None:
    folder = davis.write(builtin, tmp_path)
    path = tmp_path / "Annotations/480p/juggle/00006.png"
    with Image.open(path) as image:
        changed = image.copy()
    changed.putpixel((3, 4), 7)
    changed.save(path)
    clip = DavisReader().read(folder)
    assert "object_7" in clip.kinds
    assert not clip[5].masks["object_7"].any() and clip[6].masks["object_7"][4, 3]


def test_partial_and_wrong_folders(builtin: Clip, tmp_path: Path) -> None:
    folder = davis.write(builtin, tmp_path, folders=True)
    (tmp_path / "Annotations/juggle/001/00003.png").unlink()
    (tmp_path / "Annotations/juggle/002/00004.png").unlink()
    with pytest.raises(ClipError) as caught:
        DavisReader().read(folder)
    told = str(caught.value)
    assert "001/00003.png" in told and "002/00004.png" in told and "DreamScene4D" in told
    with pytest.raises(ClipError, match=r"give JPEGImages/SEQUENCE"):
        DavisReader().read(tmp_path)
    empty = tmp_path / "JPEGImages/empty"
    empty.mkdir()
    with pytest.raises(ClipError, match=r"empty/00000\.jpg is absent(.|\n)*Annotations/empty"):
        DavisReader().read(empty)


def test_coloured_annotations_are_refused(builtin: Clip, tmp_path: Path) -> None:
    folder = davis.write(builtin, tmp_path)
    path = tmp_path / "Annotations/480p/juggle/00002.png"
    with Image.open(path) as image:
        image.convert("RGB").save(path)
    with pytest.raises(ClipError, match="has mode RGB; expected palette indices"):
        DavisReader().read(folder)
