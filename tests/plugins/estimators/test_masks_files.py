"""estimator:masks-files: every layout gives the same masks; what is wrong is named in one
message."""

from __future__ import annotations

from typing import Any

import av
import numpy as np
import pytest
from estimator_cases import FRAMES, HEIGHT, WIDTH, labels, mask, request, write_masks
from PIL import Image
from pydantic import ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.estimator import EntityRequest, checked
from hoigs.core.registry.registry import default_registry
from hoigs.plugins.estimators.masks_files import MasksFilesEstimator, voc_palette


def made_masks_files(**settings: Any) -> MasksFilesEstimator:
    return MasksFilesEstimator(MasksFilesEstimator.Config(**settings))


def both(i: int) -> np.ndarray:
    return mask("human", i) | mask("object", i)


def require_right(estimator: MasksFilesEstimator, video) -> None:
    """The estimator gives the masks that were written, for every entity and frame."""
    masks = checked(estimator.estimate(video), video, estimator).masks
    assert set(masks.entities) == {"human", "object"} and masks.together is None
    for name in masks.entities:
        for i in range(FRAMES):
            assert np.array_equal(masks.entities[name][i], mask(name, i)), (name, i)


def test_one_folder_an_entity(tmp_path):
    for name in ("human", "object"):
        write_masks(tmp_path / "masks" / name, lambda i, name=name: mask(name, i))
    require_right(MasksFilesEstimator(), request(tmp_path))


def test_folders_of_other_names_with_files_counted_from_one(tmp_path):
    write_masks(tmp_path / "a/001", lambda i: mask("human", i), name="frame_{:d}.png", first=1)
    write_masks(tmp_path / "a/002", lambda i: mask("object", i), name="x3_{:06d}.png", first=7)
    video = request(tmp_path)
    names = {"human": "001", "object": "002"}
    with pytest.raises(HoigsError, match=r"x3_000007\.png.* belong to no frame.*first_frame"):
        made_masks_files(path="a", names=names).estimate(video)
    (tmp_path / "a/002").rename(tmp_path / "a/x")
    write_masks(tmp_path / "a/002", lambda i: mask("object", i), name="{:d}_mask.png", first=1)
    require_right(made_masks_files(path="a", names=names), video)


def test_first_frame_says_where_the_video_starts(tmp_path):
    write_masks(tmp_path / "hoi", both, name="{:04d}.png", first=7)
    found = (
        made_masks_files(path="hoi", holds="together", first_frame=7)
        .estimate(request(tmp_path))
        .masks
    )
    assert all(np.array_equal(found.together[i], both(i)) for i in range(FRAMES))


def test_together(tmp_path):
    write_masks(tmp_path / "hoi_mask", both)
    estimator = made_masks_files(path="hoi_mask", holds="together")
    masks = checked(estimator.estimate(request(tmp_path)), request(tmp_path), estimator).masks
    assert masks.entities == {}
    assert all(np.array_equal(masks.together[i], both(i)) for i in range(FRAMES))


@pytest.mark.parametrize("form", ["palette", "grey", "davis-colours", "npy"])
def test_labels(tmp_path, form):
    numbers = {"human": 1, "object": 2}
    folder = tmp_path / "Annotations"
    folder.mkdir()
    if form == "palette":
        write_masks(folder, labels, mode="P")
    elif form == "grey":
        write_masks(folder, labels)
    else:
        for i in range(FRAMES):
            if form == "npy":
                np.save(folder / f"{i:05d}.npy", labels(i))
            else:
                colours = voc_palette()[labels(i)].astype(np.uint8)
                Image.fromarray(colours).save(folder / f"{i:05d}.png")
    require_right(
        made_masks_files(path="Annotations", holds="labels", names=numbers),
        request(tmp_path),
    )


def test_the_palette_of_davis():
    # the first colours of PASCAL VOC's palette
    expected = [(0, 0, 0), (128, 0, 0), (0, 128, 0), (128, 128, 0), (0, 0, 128)]
    assert [tuple(c) for c in voc_palette()[:5].tolist()] == expected
    assert len({tuple(c) for c in voc_palette().tolist()}) == 256


def test_colours_from_elsewhere_and_lossy_labels_are_refused(tmp_path):
    write_masks(tmp_path / "rgb", lambda i: np.full((HEIGHT, WIDTH, 3), 77, np.uint8))
    estimator = made_masks_files(path="rgb", holds="labels", names={"human": 1, "object": 2})
    masks = estimator.estimate(request(tmp_path)).masks
    with pytest.raises(HoigsError, match="#4d4d4d are not colours of the DAVIS palette"):
        masks.entities["human"][0]
    write_masks(tmp_path / "jpg", labels, name="{:05d}.jpg")
    masks = made_masks_files(path="jpg", holds="labels", names={"human": 1, "object": 2}).estimate(
        request(tmp_path)
    )
    with pytest.raises(HoigsError, match="compression blurs labels"):
        masks.masks.entities["human"][0]


def test_arrays_in_npz_are_read_without_holding_them(tmp_path):
    stacks = {n: np.stack([mask(n, i) for i in range(FRAMES)]) for n in ("human", "object")}
    np.savez_compressed(tmp_path / "masks.npz", **stacks)
    require_right(made_masks_files(path="masks.npz"), request(tmp_path))
    kept = sorted((tmp_path / "work/unpacked").iterdir())
    assert [p.suffix for p in kept] == [".npy", ".npy"]
    np.savez(tmp_path / "ids.npz", np.stack([labels(i) for i in range(FRAMES)]))
    numbers = {"human": 1, "object": 2}
    require_right(
        made_masks_files(path="ids.npz", holds="labels", names=numbers),
        request(tmp_path),
    )
    np.savez(tmp_path / "bits.npz", **{n: s.astype(np.uint8) for n, s in stacks.items()})
    require_right(made_masks_files(path="bits.npz"), request(tmp_path))


def test_a_video_of_masks(tmp_path):
    with av.open(str(tmp_path / "hoi.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv444p"
        for i in range(FRAMES):
            grey = both(i).astype(np.uint8) * 255
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, -1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    masks = made_masks_files(path="hoi.mp4", holds="together").estimate(request(tmp_path)).masks
    assert all(np.array_equal(masks.together[i], both(i)) for i in (3, 0, 4, 1, 2))
    longer = request(tmp_path, frames=FRAMES + 1)
    with pytest.raises(HoigsError, match=r"hoi\.mp4 has 5 frames, the video has 6"):
        made_masks_files(path="hoi.mp4", holds="together").estimate(longer)


def test_white_background(tmp_path):
    write_masks(tmp_path / "segmentations", lambda i: ~both(i))
    masks = made_masks_files(path="segmentations", holds="together", inside="dark").estimate(
        request(tmp_path)
    )
    assert np.array_equal(masks.masks.together[2], both(2))


def test_zero_and_one_in_grey_are_not_taken_for_empty(tmp_path):
    write_masks(tmp_path / "ones", lambda i: both(i).astype(np.uint8))
    masks = made_masks_files(path="ones", holds="together").estimate(request(tmp_path)).masks
    with pytest.raises(HoigsError, match="values up to 1 of 255: set `inside: nonzero`"):
        masks.together[0]
    told = (
        made_masks_files(path="ones", holds="together", inside="nonzero")
        .estimate(request(tmp_path))
        .masks
    )
    assert np.array_equal(told.together[0], both(0))
    write_masks(tmp_path / "empty", lambda i: np.zeros((HEIGHT, WIDTH), bool))
    empty = made_masks_files(path="empty", holds="together").estimate(request(tmp_path)).masks
    assert not empty.together[0].any()


def test_one_message_names_all_that_is_absent_or_of_another_size(tmp_path):
    human = write_masks(tmp_path / "masks/human", lambda i: mask("human", i))
    (human / "00001.png").unlink()
    (human / "00003.png").unlink()
    Image.new("L", (20, 20)).save(human / "00004.png")
    with pytest.raises(HoigsError) as caught:
        MasksFilesEstimator().estimate(request(tmp_path))
    text = str(caught.value)
    assert "lacks 2 of 5 frames: 1, 3" in text
    assert "00004.png: 20x20, the video is 32x24" in text
    assert "masks/object: no such file or folder" in text
    assert "come from your segmenter" in text


def test_frames_that_nobody_wants_need_no_file(tmp_path):
    folder = write_masks(tmp_path / "hoi", both)
    (folder / "00001.png").unlink()
    video = request(tmp_path, wanted=(0, 2, 4))
    masks = made_masks_files(path="hoi", holds="together").estimate(video).masks
    assert np.array_equal(masks.together[2], both(2))
    with pytest.raises(HoigsError, match="no mask of frame 1"):
        masks.together[1]
    empty = (
        made_masks_files(path="hoi", holds="together", missing="empty")
        .estimate(request(tmp_path))
        .masks
    )
    assert not empty.together[1].any()


def test_resize_takes_other_sizes_but_not_other_shapes(tmp_path):
    write_masks(tmp_path / "big", lambda i: np.kron(both(i), np.ones((3, 3), bool)))
    with pytest.raises(HoigsError, match="and 4 more files: 96x72, the video is 32x24"):
        made_masks_files(path="big", holds="together").estimate(request(tmp_path))
    masks = (
        made_masks_files(path="big", holds="together", resize=True)
        .estimate(request(tmp_path))
        .masks
    )
    assert np.array_equal(masks.together[1], both(1))
    write_masks(tmp_path / "turned", lambda i: both(i).T)
    with pytest.raises(HoigsError, match="the proportions differ"):
        made_masks_files(path="turned", holds="together", resize=True).estimate(request(tmp_path))


def test_names_and_paths_that_are_nearly_right(tmp_path):
    write_masks(tmp_path / "masks/humans", lambda i: mask("human", i))
    write_masks(tmp_path / "masks/object", lambda i: mask("object", i))
    with pytest.raises(HoigsError, match='did you mean "humans"'):
        MasksFilesEstimator().estimate(request(tmp_path))
    with pytest.raises(HoigsError, match='did you mean "masks"'):
        made_masks_files(path="mask").estimate(request(tmp_path))
    with pytest.raises(HoigsError, match='not requested: "humn"; did you mean "human"'):
        made_masks_files(names={"humn": "humans"}).estimate(request(tmp_path))
    with pytest.raises(HoigsError, match='give the number of "object"'):
        made_masks_files(path="masks/object", holds="labels", names={"human": 1}).estimate(
            request(tmp_path)
        )


def test_damaged_files_are_named(tmp_path):
    folder = write_masks(tmp_path / "hoi", both)
    (folder / "00002.png").write_bytes(b"no image")
    with pytest.raises(HoigsError, match=r"00002.png is no readable image"):
        made_masks_files(path="hoi", holds="together").estimate(request(tmp_path))
    (tmp_path / "m.npz").write_bytes(b"no archive")
    with pytest.raises(HoigsError, match=r"m\.npz is no readable \.npz file"):
        made_masks_files(path="m.npz", holds="together").estimate(request(tmp_path))


def test_from_a_spec(tmp_path):
    registry = default_registry()
    config = registry.config_class("estimator:masks-files")
    settings = config(path="Annotations", holds="labels", names={"human": 1, "object": 2})
    estimator = registry.get("estimator:masks-files").from_config(settings, BuildContext())
    write_masks(tmp_path / "Annotations", labels, mode="P")
    require_right(estimator, request(tmp_path))
    with pytest.raises(ValidationError, match="hold"):
        config(hold="labels")


def test_the_supplied_masks(shared_data):
    folder = shared_data / "juggle"
    video = request(
        folder, frames=247, width=1280, height=720, entities=(EntityRequest("human", "human"),)
    )
    estimator = made_masks_files(path="hoi_mask", holds="together")
    masks = checked(estimator.estimate(video), video, estimator).masks
    with Image.open(folder / "hoi_mask" / "00100.png") as image:
        assert np.array_equal(masks.together[100], np.asarray(image.convert("L")) > 127)
    assert 0.01 < masks.together[100].mean() < 0.5
