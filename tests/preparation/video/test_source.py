"""A source is known by its contents; what is absent is named, all at once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from hoigs.core.system.colmap_files import choice_told
from hoigs.preparation.video.source import SourceError, clip_named_after, find_source


def test_finds_everything(tiny_source: Path) -> None:
    source = find_source(tiny_source)
    assert source.video.name == "video.mp4"
    assert source.beside["masks"].settings["path"] == "hoi_mask" and source.ball is not None
    assert source.beside["landmarks"].use == "estimator:landmarks-files" and len(source.beside) == 2
    (tiny_source / "depth").mkdir()
    assert set(find_source(tiny_source).beside) == {"landmarks", "masks", "depth"}
    assert set(find_source(tiny_source, given={"depth", "masks"}).beside) == {"landmarks"}
    assert source.colmap is None


def test_a_bare_video_names_all_that_is_absent(tiny_video: Path) -> None:
    with pytest.raises(SourceError) as error:
        find_source(tiny_video)
    message = str(error.value)
    for part in (
        "pose_mediapipe.npz: body landmarks, from MediaPipe Pose",
        "masks/human/00000.png",
        "masks/object/00000.png",
        "video segmenter",
        "COLMAP",
    ):
        assert part in message


def test_an_empty_folder_names_the_video_too(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"a video \(\.mp4"):
        find_source(tmp_path)
    with pytest.raises(SourceError, match=r"nothing\b"):
        find_source(tmp_path / "nothing")


def test_two_videos_are_ambiguous(tiny_source: Path) -> None:
    shutil.copy(tiny_source / "video.mp4", tiny_source / "other.MOV")
    with pytest.raises(SourceError, match=r"other\.MOV, video\.mp4"):
        find_source(tiny_source)


def test_masks_apart(tiny_source: Path) -> None:
    (tiny_source / "masks").mkdir()
    (tiny_source / "hoi_mask").rename(tiny_source / "masks/human")
    source = find_source(tiny_source)  # the ball track stands for the object's mask
    assert source.beside["masks"].settings["path"] == "masks" and source.masked == ("human",)
    (tiny_source / "ball_track.npz").unlink()
    with pytest.raises(SourceError, match="masks/object/00000"):
        find_source(tiny_source)


def test_an_empty_sparse_folder_is_not_a_static_camera(tiny_source: Path) -> None:
    (tiny_source / "sparse").mkdir()
    with pytest.raises(SourceError, match="COLMAP"):
        find_source(tiny_source)
    (tiny_source / "sparse/0").mkdir()
    for name in ("cameras", "images", "points3D"):
        (tiny_source / f"sparse/0/{name}.txt").write_text("")
    assert find_source(tiny_source).colmap == tiny_source / "sparse/0"


def test_an_empty_video_is_said_before_what_is_absent(tmp_path: Path) -> None:
    (tmp_path / "video.mp4").write_bytes(b"")
    for path in (tmp_path, tmp_path / "video.mp4"):
        with pytest.raises(SourceError, match=r"video\.mp4.*0 bytes"):
            find_source(path)


def test_the_largest_colmap_model_is_taken(tiny_source: Path) -> None:
    for name, images in (("0", 3), ("1", 5), ("2", 9)):
        model = tiny_source / "sparse" / name
        model.mkdir(parents=True)
        for part in ("cameras", "points3D") if name != "2" else ("cameras",):  # 2 is cut off
            (model / f"{part}.txt").write_text("")
        rows = [f"{i} 1 0 0 0 0 0 0 1 a frame {i}.png\n\n" for i in range(images)]
        (model / "images.txt").write_text("".join(rows))
    assert find_source(tiny_source).colmap == tiny_source / "sparse/1"
    told = choice_told(tiny_source / "sparse", tiny_source / "sparse/1")
    assert told is not None and "sparse/0 (3 images)" in told and "sparse/1 (5 images)" in told


def test_a_clip_is_named_after_its_video(tmp_path: Path) -> None:
    (tmp_path / "on the beach").mkdir()
    assert clip_named_after(tmp_path / "on the beach") == Path("clips/on-the-beach")
    assert clip_named_after(tmp_path / "Me & you.mp4") == Path("clips/Me-you")
    assert clip_named_after(Path("https://host/dance.mp4")) == Path("clips/dance")
    assert clip_named_after(Path()) == Path("clips/mine")
