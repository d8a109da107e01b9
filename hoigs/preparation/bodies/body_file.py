"""Bodies of other programs: GVHMR's hmr4d_results.pt and WHAM's wham_output.pkl.

Both hold joint rotations in the convention of SMPL and the body's place in the camera. Their shape
coefficients belong to SMPL's licensed models and are not used: the pelvis, which shape moves by a
centimetre or two, is that of the mean shape.
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
from hoigs.core.unpickling.joblib_file import load_joblib
from hoigs.core.values.lens import Lens
from hoigs.preparation.body.kinematics import nearest_turn
from hoigs.preparation.video.source import LANDMARKS, SourceError

SUFFIXES = (".pt", ".pkl")
USUAL_NAMES = ("hmr4d_results.pt", "wham_output.pkl")
# pelvis of the mean shape before `transl`, metres
SMPL_PELVIS = (-0.0018, -0.2233, 0.0282)
SMPLX_PELVIS = (0.0031, -0.3514, 0.0120)
EXPECTED = {
    "GVHMR": "smpl_params_incam with global_orient [F, 3], body_pose [F, 63], transl [F, 3], and "
    "K_fullimg [F, 3, 3]",
    "WHAM": "of each person pose [N, 72], trans [N, 3] and frame_ids [N]",
}


@dataclass(frozen=True)
class FileBody:
    """One person, as a program has written them.

    Attributes:
        program: who wrote it. path: the file.
        frames: of the video that it has, rising.
        turns: axis-angle of SMPL's joints 0..21, the first in the camera's axes.
        pelvis: place in the camera (x right, y down, z away), metres.
        intrinsics: pixels of the video; None: WHAM's, which follow from its size.
        people: that the file has; this one is in most frames.
    """

    program: str
    path: Path
    frames: Int[np.ndarray, " N"]
    turns: Float[np.ndarray, "N 22 3"]
    pelvis: Float[np.ndarray, "N 3"]
    intrinsics: Float[np.ndarray, "N 3 3"] | None
    people: int = 1

    def K(self, width: int, height: int) -> Float[np.ndarray, "N 3 3"]:
        """Intrinsics of each frame of a video of this size.

        Raises:
            SourceError: the file belongs to a video of another size.
        """
        if self.intrinsics is None:
            focal = math.hypot(width, height)
            one = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
            return np.broadcast_to(one, (len(self.frames), 3, 3))
        size = 2 * np.median(self.intrinsics[:, :2, 2], axis=0)
        if np.abs(size / (width, height) - 1).max() > 0.02:
            raise SourceError(
                f"{self.path}: K_fullimg is of a video of {size[0]:.0f}x{size[1]:.0f} pixels, this "
                f"one has {width}x{height}; run {self.program} on this video"
            )
        return self.intrinsics

    def gives_landmarks(self, others: Collection[str], named: bool) -> bool:
        """Landmarks are taken from this body: no estimator of them is named in `others`, and there
        is no file of them beside it, unless this one is `named`."""
        beside = (self.path.parent / LANDMARKS).is_file()
        return "landmarks" not in others and (named or not beside)

    def lens(self, width: int, height: int) -> tuple[Lens, str]:
        """The middle of its intrinsics over the frames, and where they come from."""
        K = np.median(self.K(width, height), axis=0)
        params = tuple(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        return Lens("PINHOLE", params, width, height), f"{self.program}'s, in {self.path.name}"

    def used(self, numbers: Sequence[int]) -> str:
        """What became of it in a clip of these frames, for the report."""
        lacking = len(set(numbers) - set(self.frames.tolist()))
        lines = [f"started from {self.program}'s joint rotations in {self.path.name}"]
        if lacking:
            lines.append(f"interpolated in {lacking} of {len(numbers)} frames that it lacks")
        if self.people > 1:
            lines.append(f"of its {self.people} people the one in most frames")
        return ", ".join(lines) + "; its shape is not used"

    def rotations(self, numbers: Sequence[int]) -> Float[torch.Tensor, "F 21 3"]:
        """Axis-angle of joints 1..21 in these frames; those that it lacks are interpolated."""
        joints = torch.from_numpy(self.turns[:, 1:]).unbind(1)
        turns = torch.stack([nearest_turn(joint) for joint in joints], 1).numpy()
        columns = turns.reshape(len(turns), -1).T
        filled = np.stack([np.interp(numbers, self.frames, column) for column in columns], -1)
        return torch.from_numpy(filled).float().unflatten(-1, (21, 3))


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
    for path in sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES and p.is_file()):
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
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
            reason = str(error).strip().splitlines() or [type(error).__name__]
            raise SourceError(
                f"{path} cannot be read as tensors alone, without running code: {reason[0]}"
            ) from error
        return _gvhmr(content, path) if _has(content, "smpl_params_incam") else None
    try:
        content = load_joblib(path)
    except ClipError as error:
        raise SourceError(str(error)) from error
    people = list(content.values()) if isinstance(content, Mapping) else []
    known = [p for p in people if _has(p, "pose") and _has(p, "trans") and _has(p, "frame_ids")]
    return _wham(known, path) if known else None


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
    if np.any(np.diff(frames) <= 0) or frames[0] < 0:
        raise SourceError(f"{path}: frame_ids do not rise from 0; expected {EXPECTED['WHAM']}")
    return FileBody(
        "WHAM", path, frames, pose[:, :22], trans + SMPL_PELVIS, None, people=len(people)
    )


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
