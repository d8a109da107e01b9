"""Layouts of files of GVHMR, WHAM, TRAM, PHALP (4D-Humans), PromptHMR and SAM 3D Body.

The first five hold joint rotations in the convention of SMPL and the body's place in the camera.
Their shape coefficients belong to SMPL's licensed models and are not used: the pelvis, which shape
moves by a centimetre or two, is that of the mean shape. SAM 3D Body's rotations are those of
another skeleton (MHR); its keypoints in space, which have its person's size, are read instead.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.body import PELVIS, BodyModel
from hoigs.core.interfaces.estimator import Estimates, Estimator, Landmarks, VideoRequest
from hoigs.core.maths.rotations import matrices_to_axis_angle
from hoigs.core.maths.skinning import skin
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.files import regular_file
from hoigs.core.system.joblib_file import load_joblib
from hoigs.core.system.unpickling import load_pickled_npy
from hoigs.core.values.lens import Lens
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.kinematics import nearest_turn
from hoigs.preparation.body.landmarks import points_of
from hoigs.preparation.video.source import LANDMARKS, SourceError

# A body that another program has fitted, and what of it a clip takes.


@dataclass(frozen=True)
class FileBody:
    """One person, as a program has written them.

    Attributes:
        program: who wrote it. path: the file.
        frames: of the video that it has, rising.
        turns: axis-angle of SMPL's joints 0..21, the first in the camera's axes; None where the
            program has another skeleton, and gives `places`.
        pelvis: place in the camera (x right, y down, z away), metres.
        intrinsics: pixels of the video; None: those of `focal`, with the centre in the middle.
        people: that the file has; this one is in most frames.
        resized: the program made the video smaller, and `intrinsics` are of that.
        focal: in diagonals of the picture, or in its longer sides where `weak`.
        weak: the program knows no distance, and its focal length is a convention.
        places: of MediaPipe's landmarks in the camera, metres, NaN where it has none; None: those
            of hoigs' own body in these rotations.
    """

    program: str
    path: Path
    frames: Int[np.ndarray, " N"]
    turns: Float[np.ndarray, "N 22 3"] | None
    pelvis: Float[np.ndarray, "N 3"]
    intrinsics: Float[np.ndarray, "N 3 3"] | None
    people: int = 1
    resized: bool = False
    focal: float = 1.0
    weak: bool = False
    places: Float[np.ndarray, "N 33 3"] | None = None

    def K(self, width: int, height: int) -> Float[np.ndarray, "N 3 3"]:
        """Intrinsics of each frame of a video of this size.

        Raises:
            SourceError: the file belongs to a video of another size.
        """
        if self.intrinsics is None:
            focal = self.focal * (max(width, height) if self.weak else math.hypot(width, height))
            one = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
            return np.broadcast_to(one, (len(self.frames), 3, 3))
        size = 2 * np.median(self.intrinsics[:, :2, 2], axis=0)
        if self.resized and abs(size[0] * height / (size[1] * width) - 1) < 0.02:
            return self.intrinsics * np.array([[width / size[0]], [height / size[1]], [1.0]])
        if np.abs(size / (width, height) - 1).max() > 0.02:
            raise SourceError(
                f"{self.path}: its intrinsics are of a video of {size[0]:.0f}x{size[1]:.0f} px, "
                f"this one has {width}x{height}; run {self.program} on this video"
            )
        return self.intrinsics

    def gives_landmarks(self, others: Collection[str], named: bool) -> bool:
        """Landmarks are taken from this body: no estimator of them is named in `others`, and there
        is no file of them beside it, unless this one is `named`."""
        beside = (self.path.parent / LANDMARKS).is_file()
        return "landmarks" not in others and (named or not beside)

    def lens(self, width: int, height: int) -> tuple[Lens, str] | None:
        """The middle of its intrinsics over the frames, and where they come from; None where they
        are a convention."""
        if self.weak:
            return None
        K = np.median(self.K(width, height), axis=0)
        params = tuple(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        return Lens("PINHOLE", params, width, height), f"{self.program}'s, in {self.path.name}"

    def used(self, numbers: Sequence[int]) -> str:
        """What became of it in a clip of these frames, for the report."""
        lacking = len(set(numbers) - set(self.frames.tolist()))
        if self.turns is None:
            lines = [f"landmarks are {self.program}'s keypoints in {self.path.name}"]
        else:
            lines = [f"started from {self.program}'s joint rotations in {self.path.name}"]
        if lacking:
            lines.append(f"interpolated in {lacking} of {len(numbers)} frames that it lacks")
        if self.people > 1:
            lines.append(f"of its {self.people} people the one in most frames")
        return ", ".join(lines) + "; its shape is not used"

    def rotations(self, numbers: Sequence[int]) -> Float[torch.Tensor, "F 21 3"] | None:
        """Axis-angle of joints 1..21 in these frames; those that it lacks are interpolated. None
        where the program has another skeleton."""
        if self.turns is None:
            return None
        joints = torch.from_numpy(self.turns[:, 1:]).unbind(1)
        turns = torch.stack([nearest_turn(joint) for joint in joints], 1).numpy()
        columns = turns.reshape(len(turns), -1).T
        filled = np.stack([np.interp(numbers, self.frames, column) for column in columns], -1)
        return torch.from_numpy(filled).float().unflatten(-1, (21, 3))


HIPS = (23, 24)  # landmarks
# pelvis of the mean shape before `transl`, metres
SMPL_PELVIS = (-0.0018, -0.2233, 0.0282)
SMPLX_PELVIS = (0.0031, -0.3514, 0.0120)
# PHALP sees the picture in a square of 256 pixels (`render.res`), with this focal length
PHALP_FOCAL = 5000 / 256
EXPECTED = {
    "GVHMR": "smpl_params_incam with global_orient [F, 3], body_pose [F, 63], transl [F, 3], and "
    "K_fullimg [F, 3, 3]",
    "WHAM": "of each person pose [N, 72], trans [N, 3] and frame_ids [N]",
    "TRAM": "pred_rotmat [N, 24, 3, 3], pred_trans [N, 1, 3] and frame [N], and beside hps/ "
    "camera.npy with img_focal and img_center",
    "PHALP": "by frame tid, tracked_time, time, and smpl with global_orient [1, 3, 3] and "
    "body_pose [23, 3, 3], and camera [3] of each person",
    "PromptHMR": "people with frames [N] and smplx_cam with pose [N, 75] and trans [N, 3], and "
    "camera with img_focal and img_center",
    "SAM 3D Body": "a list with the list of people of each frame, as process_one_image returns it: "
    "pred_keypoints_3d [70, 3], pred_keypoints_2d [70, 2], pred_cam_t [3] and focal_length of each",
}
# MHR's 70 keypoints (sam_3d_body/metadata/mhr70.py) -> MediaPipe's landmarks; of the fingers, the
# joints nearest to the palm
MHR_LANDMARKS = {
    0: 0, 1: 2, 2: 5, 3: 7, 4: 8, 5: 11, 6: 12, 7: 13, 8: 14, 9: 23, 10: 24, 11: 25, 12: 26, 13: 27,
    14: 28, 15: 31, 17: 29, 18: 32, 20: 30, 23: 22, 28: 20, 40: 18, 41: 16, 44: 21, 49: 19, 61: 17,
    62: 15,
}  # fmt: skip


def body_of(content: Any, path: Path) -> FileBody | None:
    """The body of a file's content; None if it is not that of a known program.

    Raises:
        SourceError: it is, and lacks something.
    """
    if _has(content, "smpl_params_incam"):
        return _gvhmr(content, path)
    if _has(content, "pred_rotmat") and _has(content, "pred_trans"):
        return _tram(content, path)
    if _has(content, "people") and _has(content, "camera"):
        return _prompthmr(content, path)
    if isinstance(content, list) and any(
        isinstance(people, list) and people and _has(people[0], "pred_keypoints_3d")
        for people in content
    ):
        return _sam_3d_body(content, path)
    rows = list(content.values()) if isinstance(content, Mapping) else []
    if rows and all(_has(row, "tid") and _has(row, "smpl") for row in rows):
        return _phalp(rows, path)
    people = [p for p in rows if _has(p, "pose") and _has(p, "trans") and _has(p, "frame_ids")]
    return _wham(people, path) if people else None


def _has(value: Any, key: str) -> bool:
    return isinstance(value, Mapping) and key in value


def _gvhmr(content: Mapping[str, Any], path: Path) -> FileBody:
    params = content["smpl_params_incam"]
    root = _numbers(params, "global_orient", (3,), path, "GVHMR")
    body = _numbers(params, "body_pose", (21, 3), path, "GVHMR")
    transl = _numbers(params, "transl", (3,), path, "GVHMR")
    K = _numbers(content, "K_fullimg", (3, 3), path, "GVHMR")
    _same_length((root, body, transl, K), path, "GVHMR")
    turns = np.concatenate((root[:, None], body), 1)
    return FileBody("GVHMR", path, np.arange(len(root)), turns, transl + SMPLX_PELVIS, K)


def _wham(people: list[Mapping[str, Any]], path: Path) -> FileBody:
    person = max(people, key=lambda one: np.size(one["frame_ids"]))
    pose = _numbers(person, "pose", (24, 3), path, "WHAM")
    trans = _numbers(person, "trans", (3,), path, "WHAM")
    frames = _numbers(person, "frame_ids", (), path, "WHAM").astype(int)
    _same_length((pose, trans, frames), path, "WHAM")
    return FileBody(
        "WHAM",
        path,
        _rising(frames, path, "WHAM"),
        pose[:, :22],
        trans + SMPL_PELVIS,
        None,
        people=len(people),
    )


def _tram(content: Mapping[str, Any], path: Path) -> FileBody:
    turns = _axes(_numbers(content, "pred_rotmat", (24, 3, 3), path, "TRAM"))
    trans = _numbers(content, "pred_trans", (3,), path, "TRAM")
    frames = _numbers(content, "frame", (), path, "TRAM").astype(int)
    _same_length((turns, trans, frames), path, "TRAM")
    folders = (path.parent, path.parent.parent)
    camera = next((f / "camera.npy" for f in folders if (f / "camera.npy").is_file()), None)
    if camera is None:
        raise SourceError(f"{path}, of TRAM, needs camera.npy; expected {EXPECTED['TRAM']}")
    try:
        K = _intrinsics(load_pickled_npy(camera), camera, "TRAM", len(frames))
    except ClipError as error:
        raise SourceError(str(error)) from error
    people = len(list(path.parent.glob("hps_track_*.npy")))
    order = np.argsort(frames, kind="stable")
    return FileBody(
        "TRAM", path, _rising(frames[order], path, "TRAM"), turns[order, :22],
        trans[order] + SMPL_PELVIS, K, people=max(1, people),
    )  # fmt: skip


def _prompthmr(content: Mapping[str, Any], path: Path) -> FileBody | None:
    people = content["people"]
    people = people.values() if isinstance(people, Mapping) else []
    fitted = [p for p in people if _has(p, "smplx_cam")]
    if not fitted:
        return None
    person = max(fitted, key=lambda one: np.size(one.get("frames", ())))
    frames = _numbers(person, "frames", (), path, "PromptHMR").astype(int)
    pose = person["smplx_cam"]
    turns = _numbers(pose, "pose", (25, 3), path, "PromptHMR")
    trans = _numbers(pose, "trans", (3,), path, "PromptHMR")
    _same_length((frames, turns, trans), path, "PromptHMR")
    K = _intrinsics(content["camera"], path, "PromptHMR", len(frames))
    return FileBody(
        "PromptHMR", path, _rising(frames, path, "PromptHMR"), turns[:, :22], trans + SMPLX_PELVIS,
        K, people=len(fitted), resized=True,
    )  # fmt: skip


def _phalp(rows: list[Mapping[str, Any]], path: Path) -> FileBody:
    """Of the person in most frames; a track that is only remembered has not been seen."""
    seen: dict[Any, list[tuple[int, Any, Any]]] = {}
    for number, row in enumerate(rows):
        lists = [row.get(name, []) for name in ("tid", "tracked_time", "smpl", "camera")]
        if len({len(values) for values in lists}) != 1:
            raise SourceError(
                f"{path}, of PHALP: frame {number} has lists of different lengths; expected "
                f"{EXPECTED['PHALP']}"
            )
        for who, since, smpl, camera in zip(*lists, strict=True):
            if int(since) == 0:
                seen.setdefault(who, []).append((int(row.get("time", number)), smpl, camera))
    if not seen:
        raise SourceError(f"{path}, of PHALP, has followed nobody")
    longest = max(seen, key=lambda who: len(seen[who]))
    person = sorted(seen[longest], key=lambda one: one[0])
    parts = {
        "global_orient": [_part(smpl, "global_orient", path) for _, smpl, _ in person],
        "body_pose": [_part(smpl, "body_pose", path) for _, smpl, _ in person],
        "camera": [camera for _, _, camera in person],
    }
    root = _numbers(parts, "global_orient", (1, 3, 3), path, "PHALP")
    body = _numbers(parts, "body_pose", (23, 3, 3), path, "PHALP")
    camera = _numbers(parts, "camera", (3,), path, "PHALP")
    _same_length((root, body, camera), path, "PHALP")
    turns = _axes(np.concatenate((root, body), 1))
    frames = _rising(np.array([number for number, _, _ in person]), path, "PHALP")
    return FileBody(
        "PHALP", path, frames, turns[:, :22], camera + SMPL_PELVIS, None, people=len(seen),
        focal=PHALP_FOCAL, weak=True,
    )  # fmt: skip


def _sam_3d_body(content: list[Any], path: Path) -> FileBody:
    """Of the largest person in the first frame that has any, and then the nearest to the last one:
    the program sees each frame alone, and gives people no names."""
    program = "SAM 3D Body"
    frames, chosen, most = [], [], 1
    last: Float[np.ndarray, "70 2"] | None = None
    for number, people in enumerate(content):
        if not isinstance(people, list):
            raise SourceError(f"{path}: frame {number} is no list; expected {EXPECTED[program]}")
        if not people:
            continue
        rows = {"pred_keypoints_2d": [_of(one, "pred_keypoints_2d", path) for one in people]}
        pixels = _numbers(rows, "pred_keypoints_2d", (70, 2), path, program)
        if last is None:
            k = int(np.ptp(pixels, axis=1).prod(-1).argmax())
        else:
            k = int(np.linalg.norm(pixels - last, axis=-1).mean(-1).argmin())
        frames.append(number)
        chosen.append(people[k])
        last, most = pixels[k], max(most, len(people))
    parts = {
        name: [_of(one, name, path) for one in chosen]
        for name in ("pred_keypoints_3d", "pred_keypoints_2d", "pred_cam_t", "focal_length")
    }
    shift = _numbers(parts, "pred_cam_t", (1, 3), path, program)
    points = _numbers(parts, "pred_keypoints_3d", (70, 3), path, program) + shift
    pixels = _numbers(parts, "pred_keypoints_2d", (70, 2), path, program)
    focal = _numbers(parts, "focal_length", (), path, program)
    _same_length((points, pixels, focal), path, program)
    # the file has no principal point, but what was projected with it
    middle = np.median(pixels - focal[:, None, None] * points[..., :2] / points[..., 2:], axis=1)
    K = np.tile(np.eye(3), (len(focal), 1, 1))
    K[:, 0, 0] = K[:, 1, 1] = focal
    K[:, :2, 2] = middle
    places = np.full((len(focal), 33, 3), np.nan)
    places[:, list(MHR_LANDMARKS.values())] = points[:, list(MHR_LANDMARKS)]
    hips = places[:, list(HIPS)].mean(1)
    return FileBody(program, path, np.array(frames), None, hips, K, people=most, places=places)


def _of(person: Any, name: str, path: Path) -> Any:
    if not _has(person, name):
        raise SourceError(
            f"{path}, of SAM 3D Body: a person has no {name}; expected {EXPECTED['SAM 3D Body']}"
        )
    return person[name]


def _part(smpl: Any, name: str, path: Path) -> Any:
    if not _has(smpl, name):
        raise SourceError(f"{path}, of PHALP, has no smpl.{name}; expected {EXPECTED['PHALP']}")
    return smpl[name]


def _axes(matrices: Float[np.ndarray, "N J 3 3"]) -> Float[np.ndarray, "N J 3"]:
    return matrices_to_axis_angle(torch.from_numpy(matrices)).numpy()


def _intrinsics(camera: Any, path: Path, program: str, count: int) -> Float[np.ndarray, "N 3 3"]:
    """From img_focal and img_center, which are one for all frames."""
    focal = _numbers(camera, "img_focal", (), path, program)[0]
    center = _numbers(camera, "img_center", (2,), path, program)[0]
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1.0]])
    return np.broadcast_to(K, (count, 3, 3)).copy()


def _rising(frames: np.ndarray, path: Path, program: str) -> np.ndarray:
    if np.any(np.diff(frames) <= 0) or frames[0] < 0:
        raise SourceError(f"{path}: its frames do not rise from 0; expected {EXPECTED[program]}")
    return frames


def _numbers(
    values: Any, name: str, shape: tuple[int, ...], path: Path, program: str
) -> Float[np.ndarray, "N ..."]:
    """A float64 array of rows of `shape`, flat or not, of numbers alone."""
    expected = f"expected {EXPECTED[program]}"
    if not _has(values, name):
        raise SourceError(f"{path}, of {program}, has no {name}; {expected}")
    try:
        array = np.asarray(values[name], dtype=np.float64)
        found = array.reshape(-1, *shape)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}, of {program}: {name}: {error}; {expected}") from error
    if not len(found) or not np.isfinite(found).all():
        raise SourceError(f"{path}, of {program}: {name} is empty or not finite; {expected}")
    return found


def _same_length(arrays: tuple[np.ndarray, ...], path: Path, program: str) -> None:
    lengths = [len(array) for array in arrays]
    if len(set(lengths)) > 1:
        raise SourceError(
            f"{path}, of {program}: its arrays have {lengths} rows; expected {EXPECTED[program]}"
        )


# Bodies of other programs: the file that lies beside a video, known by its content.

SUFFIXES = (".pt", ".pkl")
USUAL_NAMES = ("hmr4d_results.pt", "wham_output.pkl")


def body_beside(source: Path, named: str | None) -> FileBody | None:
    """The body in the file `named`, or else in the one beside the video, if there is one.

    Raises:
        SourceError: as `read_bodies` and `find_bodies`.
    """
    folder = source if source.is_dir() else source.parent
    if named is not None:
        path = folder / Path(named).expanduser()
        if not path.is_file():
            raise SourceError(f"--set bodies: {path} does not exist")
        return read_bodies(path)
    return find_bodies(folder) if source.exists() else None


def find_bodies(folder: Path) -> FileBody | None:
    """The one such file of a folder, known by its content; None without one.

    Raises:
        SourceError: there are several, or one of the usual names cannot be read.
    """
    found = []
    for path in _candidates(folder):
        try:
            body = _recognised(path)
        except SourceError:
            if path.name in USUAL_NAMES:
                raise
            continue  # another program's file, which happens to lie here
        if body is not None:
            found.append(body)
    if len(found) > 1:
        names = ", ".join(body.path.name for body in found)
        raise SourceError(f"{folder} holds several files of bodies, {names}: leave one there")
    return found[0] if found else None


def _candidates(folder: Path) -> list[Path]:
    """Files that may hold bodies; of TRAM's, one a person, the first, which has most frames."""
    found = sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES and p.is_file())
    tracks = sorted([*folder.glob("hps_track_*.npy"), *folder.glob("hps/hps_track_*.npy")])
    return found + tracks[:1]


def read_bodies(path: Path) -> FileBody:
    """The body in a file.

    Raises:
        SourceError: it cannot be read as plain numbers, or is of no known program.
    """
    body = _recognised(path)
    if body is None:
        expected = "; ".join(f"{program}: {what}" for program, what in EXPECTED.items())
        raise SourceError(f"{path} holds no bodies of a known program; expected {expected}")
    return body


def _recognised(path: Path) -> FileBody | None:
    """The body in a file, or None if its content is not that of a known program."""
    if path.suffix == ".pt":
        try:
            file = regular_file(path)
            content = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
        except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
            reason = str(error).strip().splitlines() or [type(error).__name__]
            raise SourceError(
                f"{path} cannot be read as tensors alone, without running code: {reason[0]}"
            ) from error
        return body_of(content, path)
    try:
        content = load_pickled_npy(path) if path.suffix == ".npy" else load_joblib(path)
    except ClipError as error:
        raise SourceError(str(error)) from error
    return body_of(content, path)


# Landmarks of a body that another program has fitted, on hoigs' own body in the same pose.

OUTSIDE = 0.2  # visibility beyond the picture, where the program has guessed
# metres by which a component of a joint is off: of 55 to 58 mm a joint on 3DPW (GVHMR, Shen et al.
# 2024; WHAM, Shin et al. 2024; SAM 3D Body, Yang et al. 2026)
SPREAD = 0.035


class BodyFileEstimator(Estimator):
    """The points of the posed body, or the program's own, that stand for MediaPipe's landmarks.

    Args:
        path: of the file. body: in its mean shape.
    """

    provides = frozenset({"landmarks"})

    def __init__(self, path: Path, body: BodyModel) -> None:
        self.path, self.body = path, body

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        found = read_bodies(self.path)
        if found.frames[-1] >= video.frames:
            raise SourceError(
                f"{self.path} has frame {found.frames[-1]}, the video {video.frames} frames: run "
                f"{found.program} on this video"
            )
        if found.places is None:
            marks = list(points_of(self.body).landmarks)
            places = _places(self.body, found)
        else:
            marks = sorted(MHR_LANDMARKS.values())
            places = found.places[:, marks]
        K = found.K(video.width, video.height)
        seen = np.einsum("nij,nlj->nli", K, places)
        pixels = seen[..., :2] / seen[..., 2:].clip(1e-3)
        inside = ((pixels >= 0) & (pixels < (video.width, video.height))).all(-1)
        visible = np.where(inside, 1.0, OUTSIDE)[..., None]
        middle = places[:, [marks.index(hip) for hip in HIPS]].mean(1, keepdims=True)
        depth = (places - middle)[..., 2:] * (K[:, :1, :1] / middle[..., 2:])
        image = np.full((video.frames, 33, 4), np.nan, np.float32)
        world = image.copy()
        rows = np.ix_(found.frames, np.array(marks))
        image[rows] = np.concatenate((pixels, depth, visible), -1)
        world[rows] = np.concatenate((places - middle, visible), -1)
        (name,) = video.named("human") or ("human",)
        progress(1.0, "bodies")
        marked = Landmarks(image, world, found.program, world_spread=SPREAD)
        return Estimates(landmarks={name: marked})


def _places(body: BodyModel, found: FileBody) -> Float[np.ndarray, "N L 3"]:
    """Of landmarks on the posed body, along the camera's axes, metres."""
    assert found.turns is not None
    points = points_of(body)
    vertices, joints = body.shaped(torch.zeros(body.num_betas))
    turns = torch.from_numpy(found.turns).float()
    pose = BodyPose.zeros(len(turns), betas=body.num_betas).replace(
        global_orient=turns[:, 0],
        body=turns[:, 1:],
        transl=torch.from_numpy(found.pelvis).float() - joints[PELVIS],
    )
    bound = torch.cat(
        (torch.eye(len(joints))[points.joints], body.skinning_weights[points.vertices])
    )
    rest = torch.cat((joints[points.joints], vertices[points.vertices]))
    return skin(rest, body.skinning_transforms(pose), bound).double().numpy()
