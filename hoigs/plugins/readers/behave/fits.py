"""BEHAVE's registrations: a pickle for each frame (1 fps), or arrays by time (30 fps)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import load_arrays
from hoigs.core.unpickling.pickles import load_pickle
from hoigs.plugins.readers.common.listing import Need
from hoigs.plugins.readers.common.numbers import entry, numbers

SITE = "https://virtualhumans.mpi-inf.mpg.de/behave"
MAKER = (
    f"Sequences of {SITE} have a fit in each frame; or put smpl_fit_all.npz and object_fit_all.npz "
    "of its 30-fps release into the sequence"
)
SAME_TIME = 0.005  # seconds; frames at 30 fps are 0.033 apart


@dataclass(frozen=True)
class Fits:
    """Registrations of the frames that have them.

    Attributes:
        frames: folders, in order. poses: axis-angle, 52 joints. places, object_places: metres, in
            the world of Kinect 1. needs: files that are absent, if no frame is registered.
    """

    frames: list[Path]
    poses: Float[Tensor, "F 156"]
    places: Float[Tensor, "F 3"]
    betas: Float[Tensor, "F 10"]
    object_turns: Float[Tensor, "F 3"]
    object_places: Float[Tensor, "F 3"]
    source: str
    gender: str | None = None
    needs: tuple[Need, ...] = ()


def object_names(category: str) -> tuple[str, ...]:
    """What the folder of an object's fits may be called (data/seq_utils.py: get_obj_name)."""
    detected = {"chair": "chair", "ball": "sports ball"}
    return (category, *(v for k, v in detected.items() if k in category and v != category))


def read_fits(folder: Path, frames: Sequence[Path], category: str) -> Fits:
    """The fits of a sequence, from its frames if any of them has one, else from its arrays.

    Raises:
        ClipError: a file is damaged or has another layout.
    """
    pairs = {frame: _files(frame, category) for frame in frames}
    if any(None not in pair for pair in pairs.values()):
        return _of_frames({f: p for f, p in pairs.items() if None not in p})
    body_path, object_path = folder / "smpl_fit_all.npz", folder / "object_fit_all.npz"
    if body_path.is_file() or object_path.is_file():
        absent = tuple(
            Need.of(p.name, maker=MAKER) for p in (body_path, object_path) if not p.is_file()
        )
        return _none(frames, absent) if absent else _of_arrays(frames, body_path, object_path)
    needs = []
    for frame in frames:
        person, item = _paths(frame, category)
        needs += [Need.of(*names, maker=MAKER) for names in (person, item)]
    return _none(frames, tuple(needs))


def _paths(frame: Path, category: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    person = (f"{frame.name}/person/fit02/person_fit.pkl",)
    return person, tuple(f"{frame.name}/{n}/fit01/{n}_fit.pkl" for n in object_names(category))


def _files(frame: Path, category: str) -> tuple[Path | None, ...]:
    return tuple(Need.of(*n, maker=MAKER).found(frame.parent) for n in _paths(frame, category))


def _none(frames: Sequence[Path], needs: tuple[Need, ...]) -> Fits:
    empty = torch.zeros(0, 3)
    poses, betas = torch.zeros(0, 156), torch.zeros(0, 10)
    return Fits(list(frames), poses, empty, betas, empty, empty, "", needs=needs)


def _of_frames(pairs: Mapping[Path, Any]) -> Fits:
    rows: dict[str, list[np.ndarray]] = {k: [] for k in ("pose", "trans", "betas", "angle", "at")}
    for person, item in pairs.values():
        body, track = load_pickle(person), load_pickle(item)
        for key, width in (("pose", 156), ("trans", 3), ("betas", 10)):
            rows[key].append(_numbers(body, key, width, person))
        rows["angle"].append(_numbers(track, "angle", 3, item))
        rows["at"].append(_numbers(track, "trans", 3, item))
    poses, places, betas, turns, at = (torch.from_numpy(np.stack(r)) for r in rows.values())
    return Fits(list(pairs), poses, places, betas, turns, at, "fit02 and fit01 of each frame")


def _of_arrays(frames: Sequence[Path], body_path: Path, object_path: Path) -> Fits:
    """Rows are found by time: the release leaves out frames that could not be registered."""
    try:
        body, track = load_arrays(body_path), load_arrays(object_path)
    except ValueError as error:
        raise ClipError(f"{body_path.parent}: 30-fps fits: {error}") from error
    widths = {"poses": 156, "trans": 3, "betas": 10}
    for path, table, keys in (
        (body_path, body, widths),
        (object_path, track, {"angles": 3, "trans": 3}),
    ):
        count = len(table.get("frame_times", ()))
        bad = [k for k, w in keys.items() if k not in table or table[k].shape != (count, w)]
        if bad or not count:
            raise ClipError(f"{path}: expected {keys} numbers for each of frame_times; see {bad}")
    of_body, of_track = _seconds(body["frame_times"]), _seconds(track["frame_times"])
    kept, rows, others = [], [], []
    for frame in frames:
        now = float(frame.name[1:])
        row, other = (int(np.abs(t - now).argmin()) for t in (of_body, of_track))
        if max(abs(of_body[row] - now), abs(of_track[other] - now)) <= SAME_TIME:
            kept.append(frame)
            rows.append(row)
            others.append(other)
    if not kept:
        raise ClipError(
            f"{body_path}: none of its times {of_body[0]:.3f} … {of_body[-1]:.3f} s is one of the "
            f"frames {frames[0].name} … {frames[-1].name}; are the fits of this sequence?"
        )
    poses, places, betas = (torch.from_numpy(body[k][rows].astype(np.float64)) for k in widths)
    turns, at = (torch.from_numpy(track[k][others].astype(np.float64)) for k in ("angles", "trans"))
    gender = str(body["gender"]) if "gender" in body else None
    source = "smpl_fit_all.npz and object_fit_all.npz"
    return Fits(kept, poses, places, betas, turns, at, source, gender)


def _seconds(times: np.ndarray) -> np.ndarray:
    """Seconds of "t0003.033", or of numbers.

    Raises:
        ClipError: they are something else.
    """
    texts = [str(t).removeprefix("t") for t in times]
    return numbers(np.array(texts, object), "frame_times", -1)


def _numbers(table: Any, key: str, width: int, path: Path) -> np.ndarray:
    return numbers(entry(table, key, str(path)), f"{path}: {key}", width, flat=True)
