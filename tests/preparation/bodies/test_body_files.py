"""Bodies of other programs: recognised, read without running code, and used by the body fit."""

from __future__ import annotations

import os
import pickle
from collections import defaultdict
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest
import torch
from tiny import FRAMES, HEIGHT, WIDTH, make_source

from hoigs.core.interfaces.estimator import Landmarks as ByDefault
from hoigs.core.interfaces.estimator import VideoRequest
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.preparation.body.body_files import (
    SMPL_PELVIS,
    SMPLX_PELVIS,
    BodyFileEstimator,
    body_beside,
    read_bodies,
)
from hoigs.preparation.body.priors import PosePrior, beyond
from hoigs.preparation.prepare import PrepareOptions, prepare, prepare_until
from hoigs.preparation.video.source import SourceError

FOCAL = 88.0


def gvhmr(frames: int = FRAMES) -> dict[str, Any]:
    """Someone upright, 2.8 m away, with the left elbow bent."""
    pose = torch.zeros(frames, 63)
    pose[:, 17 * 3 + 1] = -1.0
    turn = torch.tensor([np.pi, 0.0, 0.0], dtype=torch.float32).expand(frames, 3)
    place = torch.tensor((0.05, 0.0, 2.8)) - torch.tensor(SMPLX_PELVIS)
    params = {
        "global_orient": turn, "body_pose": pose, "betas": torch.zeros(frames, 10),
        "transl": place.expand(frames, 3),
    }  # fmt: skip
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return {
        "smpl_params_incam": params, "smpl_params_global": params,
        "K_fullimg": K.expand(frames, 3, 3),
    }  # fmt: skip


def wham(frames: list[int]) -> defaultdict[Any, Any]:
    people: defaultdict[Any, Any] = defaultdict(dict)
    for name, rows in ((0, frames[:1]), (3, frames)):
        pose = np.zeros((len(rows), 72), np.float32)
        pose[:, 0] = np.pi
        pose[:, 55] = np.arange(len(rows))  # an elbow that turns on
        people[name]["pose"] = pose
        people[name]["trans"] = np.full((1, len(rows), 3), 2.0)
        people[name]["frame_ids"] = np.array(rows)
    return people


PELVIS = np.array((0.05, 0.0, 2.8))  # of everybody here, in the camera
UPRIGHT = np.diag((1.0, -1.0, -1.0)).astype(np.float32)
ELBOW = axis_angle_to_matrices(torch.tensor((0.0, -1.0, 0.0))).numpy()


def tram(folder: Path, frames: list[int]) -> Path:
    """hps/hps_track_0.npy and camera.npy, as TRAM's scripts save them."""
    turns = np.tile(np.eye(3, dtype=np.float32), (len(frames), 24, 1, 1))
    turns[:, 0], turns[:, 18] = UPRIGHT, ELBOW
    place = torch.tensor(PELVIS - SMPL_PELVIS, dtype=torch.float32)
    results = {
        "pred_cam": torch.zeros(len(frames), 3), "pred_pose": torch.zeros(len(frames), 144),
        "pred_shape": torch.zeros(len(frames), 10), "pred_rotmat": torch.from_numpy(turns),
        "pred_trans": place.expand(len(frames), 1, 3), "frame": torch.tensor(frames),
    }  # fmt: skip
    (folder / "hps").mkdir()
    for k in range(2):
        np.save(folder / f"hps/hps_track_{k}.npy", np.array(results, object))
    camera = {
        "pred_cam_R": np.tile(np.eye(3), (len(frames), 1, 1)), "pred_cam_T": np.zeros((3, 3)),
        "img_focal": np.float64(FOCAL), "img_center": np.array((WIDTH / 2, HEIGHT / 2)),
    }  # fmt: skip
    np.save(folder / "camera.npy", np.array(camera, object))
    return folder / "hps/hps_track_0.npy"


def phalp(folder: Path, frames: list[int]) -> Path:
    """demo_NAME.pkl: all frames; a person who is seen in some of them, and remembered in others."""
    smpl = {
        "global_orient": UPRIGHT[None], "betas": np.zeros(10, np.float32),
        "body_pose": np.tile(np.eye(3, dtype=np.float32), (23, 1, 1)),
    }  # fmt: skip
    smpl["body_pose"][17] = ELBOW
    farther = 5000 / 256 * WIDTH / FOCAL  # in the same pixels by its longer focal length
    place = (PELVIS * (1, 1, farther) - SMPL_PELVIS).astype(np.float32)
    content: dict[str, Any] = {}
    for i in range(max(frames) + 2):
        name, people = f"outputs/_DEMO/my/img/{i + 1:06d}.jpg", [7] if i else [7, 9]
        content[name] = {
            "time": i, "shot": 0, "frame_path": name, "tid": people,
            "tracked_time": [0 if i in frames else 3, 0][: len(people)],
            "smpl": [smpl for _ in people], "camera": [place for _ in people],
            "size": [[HEIGHT, WIDTH] for _ in people], "embedding": [torch.ones(4) for _ in people],
            "mask": [[{"size": [HEIGHT, WIDTH], "counts": "ab"}] for _ in people],
            "conf": [np.float32(0.9) for _ in people],
        }  # fmt: skip
    joblib.dump(content, folder / "demo_my.pkl", compress=3)
    return folder / "demo_my.pkl"


def prompthmr(folder: Path, frames: list[int]) -> Path:
    """results.pkl, of a video that was made half as large."""
    pose = np.zeros((len(frames), 75), np.float32)
    pose[:, 0], pose[:, 55] = np.pi, -1.0
    trans = np.tile((PELVIS - SMPLX_PELVIS).astype(np.float32), (len(frames), 1))
    person = {
        "track_id": 1, "frames": np.array(frames), "bboxes": np.zeros((len(frames), 4)),
        "smplx_cam": {"pose": pose, "trans": trans, "shape": np.zeros((len(frames), 10)),
                      "rotmat": np.zeros((len(frames), 55, 3, 3), np.float32)},
    }  # fmt: skip
    other = person | {"frames": np.array(frames[:1])}
    camera = {"img_focal": np.float32(FOCAL / 2), "img_center": np.array((WIDTH, HEIGHT)) / 4}
    content = {"camera": camera, "people": {1: other, 2: person}, "timings": {}, "has_slam": True}
    joblib.dump(content, folder / "results.pkl")
    return folder / "results.pkl"


def sam_3d_body(folder: Path, frames: list[int]) -> Path:
    """What process_one_image returned for each frame: two people where there are any, in turn."""
    K = np.array(((FOCAL, 0, WIDTH / 2), (0, FOCAL, HEIGHT / 2), (0, 0, 1)))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (70, 3))
    points[9], points[10] = (0.1, 0, 0), (-0.1, 0, 0)  # the hips
    content = []
    for i in range(max(frames) + 1):
        people = []
        for size, side in ((1.0, 0.0), (0.5, 1.0)):
            place = PELVIS + np.array((side, 0.0, 0.0))
            seen = (size * points + place) @ K.T
            people.append({
                "bbox": np.zeros(4, np.float32), "focal_length": np.float32(FOCAL), "mask": None,
                "pred_keypoints_3d": (size * points).astype(np.float32),
                "pred_keypoints_2d": (seen[:, :2] / seen[:, 2:]).astype(np.float32),
                "pred_cam_t": place.astype(np.float32),
                "pred_vertices": np.zeros((9, 3), np.float32),
            })  # fmt: skip
        content.append(people[:: 1 if i % 2 else -1] if i in frames else [])
    (folder / "sam_3d_body.pkl").write_bytes(pickle.dumps(content))
    return folder / "sam_3d_body.pkl"


def test_keypoints_of_sam_3d_body(tmp_path: Path) -> None:
    path = sam_3d_body(tmp_path, [1, 2, 4])
    found = body_beside(tmp_path, None)
    assert found is not None and found.program == "SAM 3D Body" and found.path == path
    assert found.people == 2 and found.frames.tolist() == [1, 2, 4]
    assert found.rotations(range(5)) is None and found.places is not None
    np.testing.assert_allclose(found.pelvis, [PELVIS] * 3, atol=1e-6)
    np.testing.assert_allclose(found.K(WIDTH, HEIGHT)[0, :2, 2], (WIDTH / 2, HEIGHT / 2), rtol=1e-3)
    with pytest.raises(SourceError, match=r"\d+x\d+"):
        found.K(WIDTH, 3 * HEIGHT)
    video = VideoRequest(
        FRAMES, WIDTH, HEIGHT, lambda i: np.zeros((HEIGHT, WIDTH, 3), np.uint8), tmp_path, tmp_path
    )
    (marks,) = BodyFileEstimator(path, AnnyBody()).estimate(video).landmarks.values()
    assert marks.world_xyzv is not None and not marks.to_hips
    assert 0 < marks.world_spread < ByDefault(np.zeros((1, 33, 4))).world_spread
    hips = marks.image_xyzv[[1, 2, 4]][:, [23, 24], :2].mean(1)
    right = FOCAL * 0.05 / 2.8 + WIDTH / 2
    np.testing.assert_allclose(hips, [(right, HEIGHT / 2)] * 3, rtol=1e-3)
    np.testing.assert_allclose(marks.world_xyzv[1, 23, :3], (0.1, 0, 0), atol=1e-5)
    assert np.isnan(marks.image_xyzv[3]).all() and np.isfinite(marks.image_xyzv[1, 20]).all()
    content = pickle.loads(path.read_bytes())
    del content[1][0]["pred_cam_t"], content[1][1]["pred_cam_t"]
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(SourceError, match="pred_cam_t"):
        read_bodies(path)


@pytest.mark.parametrize("make", [tram, phalp, prompthmr])
def test_other_programs_say_the_same(tmp_path: Path, make: Any) -> None:
    path = make(tmp_path, [1, 2, 4])
    found = body_beside(tmp_path, None)
    assert found is not None and found.program.lower() == make.__name__ and found.path == path
    assert found.people == 2 and found.frames.tolist() == [1, 2, 4]
    np.testing.assert_allclose(np.abs(found.turns[:, 0]), [[np.pi, 0, 0]] * 3, atol=1e-3)
    np.testing.assert_allclose(found.turns[:, 18], [[0, -1, 0]] * 3, atol=1e-3)
    K = found.K(WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(K[:2, 2], (WIDTH / 2, HEIGHT / 2))
    seen, right = K @ found.pelvis[0], FOCAL * 0.05 / 2.8 + WIDTH / 2
    np.testing.assert_allclose(seen[:2] / seen[2], (right, HEIGHT / 2), rtol=1e-4)
    assert (found.lens(WIDTH, HEIGHT) is None) == found.weak == (make is phalp)
    if make is not phalp:
        np.testing.assert_allclose(K[0, 0], FOCAL)
        with pytest.raises(SourceError, match=r"\d+x\d+"):
            found.K(WIDTH, 3 * HEIGHT)


def test_tram_needs_its_camera(tmp_path: Path) -> None:
    path = tram(tmp_path, [0, 1])
    (tmp_path / "camera.npy").unlink()
    with pytest.raises(SourceError, match=r"needs camera\.npy"):
        read_bodies(path)


class Evil:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mkdir, ("ran",)


def test_wham_lacks_frames_and_has_two_people(tmp_path: Path) -> None:
    (tmp_path / "any name.pkl").write_bytes(pickle.dumps(wham([1, 3, 4])))
    found = body_beside(tmp_path, None)
    assert found is not None and found.program == "WHAM" and found.people == 2
    assert found.frames.tolist() == [1, 3, 4]
    np.testing.assert_allclose(found.K(640, 480)[0, :2, 2], (320, 240))
    np.testing.assert_allclose(found.K(640, 480)[0, 0, 0], 800)
    turns = found.rotations(range(6))
    np.testing.assert_allclose(turns[:, 17, 1], [0, 0, 0.5, 1, 2, 2])
    text = found.used(range(6))
    assert "interpolated in 3 of 6 frames" in text and "of its 2 people" in text


@pytest.mark.parametrize("name", ["hmr4d_results.pt", "wham_output.pkl"])
def test_code_in_a_file_is_not_run(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    content = {"smpl_params_incam": Evil(), "pose": Evil()}
    if name.endswith(".pt"):
        torch.save(content, name)
    else:
        Path(name).write_bytes(pickle.dumps(content))
    with pytest.raises(SourceError):
        body_beside(tmp_path, None)
    assert not (tmp_path / "ran").exists()
    (tmp_path / name).rename(tmp_path / f"other-{name}")  # of nobody's concern
    assert body_beside(tmp_path, None) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K_fullimg": torch.eye(3).expand(FRAMES - 1, 3, 3)}, r"\d+, \d+"),
        ({"K_fullimg": None}, "K_fullimg"),
        ({"smpl_params_incam": {"global_orient": torch.zeros(2, 3)}}, "body_pose"),
        ({"smpl_params_incam": 3}, "global_orient"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    torch.save(gvhmr() | change, tmp_path / "x.pt")
    with pytest.raises(SourceError, match=message):
        read_bodies(tmp_path / "x.pt")


def test_prepare_from_a_body_file_alone(tmp_path: Path, tiny_video: Path) -> None:
    source = make_source(tmp_path / "source", tiny_video)
    (source / "pose_mediapipe.npz").unlink()
    torch.save(gvhmr(), source / "hmr4d_results.pt")
    plans: list[Any] = []
    report = prepare(
        source, tmp_path / "clip", body=AnnyBody(), announce=plans.append,
        options=PrepareOptions(fit_steps=6, overlay_width=0, max_frames=4, find_object=False),
    )  # fmt: skip
    assert plans[0].choices["landmarks"].use == "GVHMR's body"
    assert "fitted to GVHMR landmarks of 4 of 4 frames" in report.provenance["body"]
    assert "GVHMR's, in hmr4d_results.pt" in report.provenance["cameras"]
    body = np.load(tmp_path / "clip" / "bodies" / "human.npz")
    np.testing.assert_allclose(body["body"][:, 17, 1], -1.0, atol=0.1)


def test_landmarks_beside_it_come_first(tmp_path: Path, tiny_video: Path) -> None:
    source = make_source(tmp_path / "source", tiny_video)
    torch.save(gvhmr(), source / "hmr4d_results.pt")
    plans: list[Any] = []
    prepare_until(
        "frames", source, tmp_path / "clip", body=AnnyBody(), announce=plans.append, object="none"
    )
    assert plans[0].choices["landmarks"].use == "estimator:landmarks-files"
    assert "hmr4d_results.pt, GVHMR's body, is not used" in plans[0].notes[-1]


def test_a_file_of_a_longer_video_is_refused(tmp_path: Path) -> None:
    torch.save(gvhmr(), tmp_path / "x.pt")
    video = VideoRequest(
        FRAMES - 1, WIDTH, HEIGHT, lambda i: np.zeros((HEIGHT, WIDTH, 3), np.uint8), tmp_path,
        tmp_path,
    )  # fmt: skip
    with pytest.raises(SourceError, match=f"{FRAMES - 1}.*{FRAMES - 1} frames"):
        BodyFileEstimator(tmp_path / "x.pt", AnnyBody()).estimate(video)


def test_a_found_pose_takes_the_place_of_rest() -> None:
    turns = 0.2 * torch.ones(2, 21, 3)
    at_rest, found = (
        float(prior.add(turns.double().flatten(1), torch.ones(2).double(), None))
        for prior in (PosePrior(), PosePrior(turns))
    )
    limits = float((beyond(turns.double()) / 0.1).square().sum())
    assert found == pytest.approx(limits) and at_rest > limits + 1
