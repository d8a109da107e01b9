"""Layouts of files of GVHMR, WHAM, TRAM, PHALP (4D-Humans) and PromptHMR.

All hold joint rotations in the convention of SMPL and the body's place in the camera. Their shape
coefficients belong to SMPL's licensed models and are not used: the pelvis, which shape moves by a
centimetre or two, is that of the mean shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.errors import ClipError
from hoigs.core.maths.rotations import matrices_to_axis_angle
from hoigs.core.unpickling.pickles import load_pickled_npy
from hoigs.preparation.bodies.file_body import FileBody
from hoigs.preparation.video.source import SourceError

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
}


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
