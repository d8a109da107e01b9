"""estimator:landmarks-files: estimators' formats give the same landmarks of the same person."""

from __future__ import annotations

import json

import numpy as np
import pytest
from estimator_cases import FRAMES, request

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    BODY_25_LANDMARKS,
    COCO_17_LANDMARKS,
    EntityRequest,
    checked,
)
from hoigs.plugins.estimators.landmarks_files import WHOLE_BODY_133, LandmarksFilesEstimator


def person(count: int, i: int, x: float = 0.0) -> np.ndarray:
    """Keypoints [count, 3] of frame `i`: x tells the keypoint, y the frame; certain."""
    return np.stack([x + np.arange(count), np.full(count, 2.0 * i), np.full(count, 0.9)], -1)


def landmarks(estimator: LandmarksFilesEstimator, video):
    return checked(estimator.estimate(video), video, estimator).landmarks


def require(track, targets, offset: float = 0.0) -> None:
    """Every landmark that a keypoint stands for is that keypoint, the others are open."""
    assert track.world_xyzv is None
    for keypoint, target in enumerate(targets):
        if target >= 0:
            assert (track.image_xyzv[:, target, 0] == offset + keypoint).all(), keypoint
            assert track.image_xyzv[:, target, 1].tolist() == [2.0 * i for i in range(FRAMES)]
    others = sorted(set(range(33)) - set(targets))
    assert np.isnan(track.image_xyzv[:, others]).all()


def test_mediapipes_own_file(tmp_path):
    image = np.random.default_rng(0).uniform(size=(FRAMES, 33, 4)).astype(np.float32)
    image[2] = np.nan
    np.savez(tmp_path / "pose_mediapipe.npz", image_xyzv=image, world_xyzv=2 * image)
    track = landmarks(LandmarksFilesEstimator(), request(tmp_path))["human"]
    np.testing.assert_array_equal(track.image_xyzv, image)
    np.testing.assert_array_equal(track.world_xyzv, 2 * image)


@pytest.mark.parametrize(
    ("count", "targets"),
    [(17, COCO_17_LANDMARKS), (25, BODY_25_LANDMARKS), (133, WHOLE_BODY_133)],
)
def test_openpose_folders(tmp_path, count, targets):
    folder = tmp_path / "openpose"
    folder.mkdir()
    for i in range(FRAMES):
        people = [{"pose_keypoints_2d": person(count, i).ravel().tolist()}]
        path = folder / f"clip_{i:012d}_keypoints.json"
        path.write_text(json.dumps({"version": 1.3, "people": people}))
    require(
        landmarks(
            LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="openpose")),
            request(tmp_path),
        )["human"],
        targets,
    )


def test_whole_body_feet_and_hands():
    # COCO-WholeBody: 17 left big toe, 22 right heel, 96 left index knuckle, 129 right little finger
    assert [WHOLE_BODY_133[k] for k in (17, 22, 96, 129)] == [31, 30, 19, 18]


def test_one_list_of_keypoints_a_frame(tmp_path):
    folder = tmp_path / "keypoints_whole_body"
    folder.mkdir()
    for i in range(FRAMES):
        (folder / f"{i}.json").write_text(json.dumps(person(133, i).tolist()))
    track = landmarks(
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="keypoints_whole_body")),
        request(tmp_path),
    )["human"]
    require(track, WHOLE_BODY_133)


@pytest.mark.parametrize("form", ["coco", "alphapose", "mmpose", "npy", "npz"])
def test_one_file(tmp_path, form):
    path = tmp_path / f"pose.{form if form.startswith('np') else 'json'}"
    stack = np.stack([person(17, i) for i in range(FRAMES)])
    if form == "npy":
        np.save(path, stack)
    elif form == "npz":
        np.savez(path, keypoints=stack)
    elif form == "mmpose":
        entries = [
            {"frame_id": i + 1, "instances": [
                {"keypoints": p[:, :2].tolist(), "keypoint_scores": p[:, 2].tolist()}]}
            for i, p in enumerate(stack)
        ]  # fmt: skip
        path.write_text(json.dumps({"meta_info": {}, "instance_info": entries}))
    else:
        entries = [
            {"image_id": i if form == "coco" else f"{i:05d}.jpg", "keypoints": p.ravel().tolist()}
            for i, p in enumerate(stack)
        ]
        path.write_text(json.dumps(entries))
    estimator = LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path=path.name))
    require(landmarks(estimator, request(tmp_path))["human"], COCO_17_LANDMARKS)


def test_one_person_is_followed_among_several(tmp_path):
    """The most certain one of the first frame, whatever the order in later ones."""
    entries = []
    for i in range(FRAMES):
        wanted, other = person(17, i, x=3.0 * i), person(17, i, x=200.0)
        other[:, 2] = 0.5 if i == 0 else 1.0
        pair = [wanted, other] if i % 2 else [other, wanted]
        entries += [{"image_id": i, "keypoints": p.ravel().tolist()} for p in pair]
    (tmp_path / "pose.json").write_text(json.dumps(entries))
    track = landmarks(
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="pose.json")), request(tmp_path)
    )["human"]
    assert track.image_xyzv[:, 0, 0].tolist() == [3.0 * i for i in range(FRAMES)]


def test_frames_where_nobody_is_found_are_open(tmp_path):
    entries = [{"image_id": i, "keypoints": person(17, i).ravel().tolist()} for i in (0, 3)]
    (tmp_path / "pose.json").write_text(json.dumps(entries))
    track = landmarks(
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="pose.json")), request(tmp_path)
    )["human"]
    found = np.isfinite(track.image_xyzv[:, 0, 0]).tolist()
    assert found == [True, False, False, True, False]


def test_several_people_have_a_file_each(tmp_path):
    for name in ("anna", "ben"):
        np.save(tmp_path / f"{name}.npy", np.stack([person(17, i) for i in range(FRAMES)]))
    entities = (EntityRequest("anna", "human"), EntityRequest("ben", "human"))
    video = request(tmp_path, entities=entities)
    with pytest.raises(HoigsError, match="2 people are requested: name each one's file"):
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="anna.npy")).estimate(video)
    with pytest.raises(HoigsError, match=r'(?s)"bem" is not requested; did you mean "ben".*"ben"'):
        LandmarksFilesEstimator(
            LandmarksFilesEstimator.Config(people={"anna": "anna.npy", "bem": "ben.npy"})
        ).estimate(video)
    estimator = LandmarksFilesEstimator(
        LandmarksFilesEstimator.Config(people={"anna": "anna.npy", "ben": "ben.npy"})
    )
    assert set(landmarks(estimator, video)) == {"anna", "ben"}


def test_what_is_wrong_is_named(tmp_path):
    video = request(tmp_path)
    with pytest.raises(HoigsError, match=r"(?s)pose_mediapipe\.npz: no such file.*MediaPipe Pose"):
        LandmarksFilesEstimator().estimate(video)
    short = np.zeros((4, 33, 4), np.float32)
    np.savez(tmp_path / "pose_mediapipe.npz", image_xyzv=short, world_xyzv=short)
    with pytest.raises(HoigsError, match="image_xyzv has 4 frames, the video has 5"):
        LandmarksFilesEstimator().estimate(video)
    np.save(tmp_path / "odd.npy", np.zeros((FRAMES, 18, 3)))
    with pytest.raises(HoigsError, match=r"shape \(5, 18, 3\).*17 \(COCO-17\)"):
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="odd.npy")).estimate(video)
    (tmp_path / "bad.json").write_text("[{]")
    with pytest.raises(HoigsError, match=r"bad\.json is no readable JSON"):
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="bad.json")).estimate(video)
    (tmp_path / "other.json").write_text('[{"bbox": [1, 2, 3, 4]}]')
    with pytest.raises(HoigsError, match="no list of COCO results"):
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="other.json")).estimate(video)
    (tmp_path / "late.json").write_text(
        json.dumps([{"image_id": 99, "keypoints": person(17, 0).ravel().tolist()}])
    )
    with pytest.raises(HoigsError, match=r"frames \[99\] are not of this video of 5"):
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="late.json")).estimate(video)
    (tmp_path / "empty.json").write_text("[]")
    with pytest.raises(HoigsError, match="no person was found"):
        LandmarksFilesEstimator(LandmarksFilesEstimator.Config(path="empty.json")).estimate(video)


def test_the_supplied_landmarks(shared_data):
    entities = (EntityRequest("human", "human"),)
    video = request(shared_data / "backpack", frames=87, width=368, height=480, entities=entities)
    track = landmarks(LandmarksFilesEstimator(), video)["human"]
    assert int(np.isfinite(track.image_xyzv[:, 0, 0]).sum()) == 58
