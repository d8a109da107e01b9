"""Estimator: requests, lazy frames, what `checked` refuses, keypoints of other conventions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hoigs.core.interfaces.estimator import (
    BODY_25_LANDMARKS,
    COCO_17_LANDMARKS,
    DepthMaps,
    EntityMasks,
    EntityRequest,
    Estimates,
    Estimator,
    Landmarks,
    LazyFrames,
    VideoRequest,
    checked,
    landmarks_from_keypoints,
)


def shade(i: int) -> np.ndarray:
    return np.full((6, 8, 3), 10 * i, np.uint8)


def request(folder: Path, **changes) -> VideoRequest:
    video = VideoRequest(5, 8, 6, shade, folder, folder / "work")
    return replace(video, **changes)


class Everything(Estimator):
    provides = frozenset({"masks", "landmarks", "depth"})

    def __init__(self, estimates: Estimates) -> None:
        self.estimates = estimates

    def estimate(self, video, progress=None):
        return self.estimates


def whole(frames: int = 5, shape: tuple[int, int] = (6, 8)) -> Estimates:
    return Estimates(
        EntityMasks({"human": [np.zeros(shape, bool)] * frames}, None, "drawn"),
        {"human": Landmarks(np.zeros((frames, 33, 4), np.float32))},
        DepthMaps([np.ones(shape, np.float32)] * frames, "metric"),
    )


def test_frames_come_in_order_checked_and_only_those_wanted(tmp_path):
    video = request(tmp_path, wanted=(1, 3))
    assert [(i, int(image[0, 0, 0])) for i, image in video.sequence()] == [(1, 10), (3, 30)]
    assert request(tmp_path).numbers == (0, 1, 2, 3, 4)
    with pytest.raises(IndexError, match="frame 5 of a video of 5"):
        video.frame(5)
    with pytest.raises(ValueError, match=r"\(6, 8, 3\), expected uint8 \(6, 9, 3\)"):
        request(tmp_path, width=9).frame(0)


def test_write_frames_writes_each_once(tmp_path):
    video = request(tmp_path, wanted=(1, 3))
    folder = video.write_frames()
    assert sorted(p.name for p in folder.iterdir()) == ["00001.png", "00003.png"]
    assert np.array_equal(np.asarray(Image.open(folder / "00003.png")), shade(3))

    def refuse(i):
        raise AssertionError("read again")

    assert request(tmp_path, wanted=(1, 3), read=refuse).write_frames() == folder


def test_paths_start_at_the_source_folder(tmp_path):
    video = request(tmp_path)
    assert video.resolve(Path("masks")) == tmp_path / "masks"
    assert video.resolve(Path("/elsewhere")) == Path("/elsewhere")
    assert video.resolve(Path("~/x")) == Path.home() / "x"


def test_entities_by_kind(tmp_path):
    entities = (EntityRequest("anna", "human"), EntityRequest("cup"), EntityRequest("ben", "human"))
    assert request(tmp_path, entities=entities).named("human") == ("anna", "ben")


def test_lazy_frames_are_read_when_asked_for():
    asked = []
    frames = LazyFrames(10, lambda i: asked.append(i) or np.array(i))
    assert len(frames) == 10 and not asked
    assert frames[-1] == 9 and [int(f) for f in frames[2:8:3]] == [2, 5]
    assert asked == [9, 2, 5]
    with pytest.raises(IndexError):
        frames[10]


def test_whole_evidence_passes(tmp_path):
    video = request(tmp_path)
    estimates = checked(whole(), video, Everything(whole()))
    assert estimates.masks.entities["human"][4].shape == (6, 8)
    assert estimates.masks.provenance == "drawn"
    assert estimates.depth.maps[0].dtype == np.float32


def test_an_absent_estimate_that_was_declared_is_named(tmp_path):
    partial = replace(whole(), depth=None, landmarks={})
    with pytest.raises(ValueError, match="Everything gave no landmarks and no depth"):
        checked(partial, request(tmp_path), Everything(partial))
    nothing = replace(whole(), masks=EntityMasks())
    with pytest.raises(ValueError, match="gave no masks: neither"):
        checked(nothing, request(tmp_path), Everything(nothing))


def test_other_frame_counts_are_refused_at_once_and_other_shapes_when_read(tmp_path):
    video = request(tmp_path)
    with pytest.raises(ValueError, match="landmarks of human: 4 frames, the video has 5"):
        checked(whole(4), video, Everything(whole(4)))
    turned = checked(whole(shape=(8, 6)), video, Everything(whole()))
    with pytest.raises(ValueError, match=r"mask of human, frame 2: bool \(8, 6\)"):
        turned.masks.entities["human"][2]
    with pytest.raises(ValueError, match="depth, frame 0"):
        turned.depth.maps[0]


def test_coco_keypoints_take_their_landmarks_and_leave_the_rest_open():
    keypoints = np.random.default_rng(0).uniform(1, 99, (2, 17, 3)).astype(np.float32)
    keypoints[..., 2] /= 100
    keypoints[1, 9, 2] = 0  # left wrist, not found
    track = landmarks_from_keypoints(keypoints, provenance="vitpose")
    image = np.isfinite(track.image_xyzv[..., [0, 1, 3]]).all(-1)
    assert track.world_xyzv is None
    assert image[0].nonzero()[0].tolist() == sorted(COCO_17_LANDMARKS)
    assert not image[1, 15] and image[1].sum() == 16
    left_wrist, right_ankle = 9, 16  # of COCO's
    assert np.array_equal(track.image_xyzv[0, 15, [0, 1, 3]], keypoints[0, left_wrist])
    assert np.array_equal(track.image_xyzv[0, 28, [0, 1, 3]], keypoints[0, right_ankle])
    assert np.isnan(track.image_xyzv[..., 2]).all()


def test_body_25_lists_sides_as_openpose_does():
    keypoints = np.full((1, 25, 3), 0.5, np.float32)
    keypoints[0, :, 0] = np.arange(25)
    track = landmarks_from_keypoints(keypoints, BODY_25_LANDMARKS)
    x = track.image_xyzv[0, :, 0]
    # OpenPose: 2 right shoulder, 7 left wrist, 19 left big toe, 24 right heel
    assert (x[12], x[15], x[31], x[30]) == (2, 7, 19, 24)
    with pytest.raises(ValueError, match="25 keypoints, expected 17"):
        landmarks_from_keypoints(keypoints)
