"""Tracks in a file, so that a video is tracked once."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    FramePrompt,
    LazyFrames,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.pixels.footage import Footage
from hoigs.plugins.estimators.object_tracker.propagation import Track


def write_tracks(
    file: Path,
    video: VideoRequest,
    footage: Footage,
    tracks: dict[str, Track | None],
    chosen: dict[str, list[FramePrompt]],
    notes: list[str],
) -> None:
    """Everything that `read_tracks` needs, under a temporary name first."""
    arrays: dict[str, np.ndarray] = {}
    none = np.zeros(footage.lab.shape[:3], np.uint8)
    soft = {n: none if t is None else t.soft for n, t in tracks.items()}
    strongest = np.max(list(soft.values()), axis=0)
    for name, track in tracks.items():
        arrays[f"soft {name}"] = np.where(soft[name] == strongest, soft[name], 0)
        confidence = np.full(video.frames, np.nan, np.float32)
        confidence[list(footage.numbers)] = 0.0 if track is None else track.confidence
        arrays[f"confidence {name}"] = confidence
    about = {
        "numbers": footage.numbers,
        "notes": notes,
        "chosen": {
            n: [[p.frame, [[q.x, q.y, q.inside] for q in p.points], p.box] for p in prompts]
            for n, prompts in chosen.items()
            if prompts
        },
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    half = file.with_suffix(".part")
    with half.open("wb") as out:
        np.savez_compressed(out, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]
    half.replace(file)


def read_tracks(file: Path, video: VideoRequest, names: Sequence[str]) -> EntityMasks:
    """The masks of objects by name, at the video's size and empty in frames that were not wanted,
    with the prompts and notes of `write_tracks`."""
    with np.load(file, allow_pickle=False) as saved:
        about = json.loads(str(saved["about"]))
        soft = {n: saved[f"soft {n}"] for n in names}
        confidence = {n: saved[f"confidence {n}"] for n in names}
    row = {number: k for k, number in enumerate(about["numbers"])}
    masks = {n: LazyFrames(video.frames, partial(_mask_at, soft[n], row, video)) for n in names}
    chosen = {
        n: tuple(
            FramePrompt(frame, tuple(PromptPoint(*p) for p in points), tuple(box) if box else None)
            for frame, points, box in prompts
        )
        for n, prompts in about["chosen"].items()
    }
    return EntityMasks(
        masks, None, "object tracker without a network", confidence, chosen, tuple(about["notes"])
    )


def _mask_at(soft: np.ndarray, row: dict[int, int], video: VideoRequest, i: int) -> np.ndarray:
    return _enlarged(soft, row.get(i), video)


def _enlarged(soft: np.ndarray, row: int | None, video: VideoRequest) -> np.ndarray:
    """A mask at the video's size; empty in frames that were not wanted."""
    from PIL import Image

    if row is None or not soft[row].any():
        return np.zeros((video.height, video.width), bool)
    image = Image.fromarray(soft[row]).resize(
        (video.width, video.height), Image.Resampling.BILINEAR
    )
    return np.asarray(image) > 127
