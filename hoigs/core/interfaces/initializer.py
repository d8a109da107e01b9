"""ObjectInitializer: a clip and the name of one of its objects in, an ObjectTrack out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch

from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.values.clip import Clip, ObjectTrack


class ObjectInitializer(Configurable, ABC):
    """An object initialiser: a clip and the name of one of its objects in, an ObjectTrack out.

    A clip carries a track of its own for every object. An initializer may keep that track's poses
    and bring better points, or place the object anew (HOIGS, Sec. "Object Initialization").
    """

    def __init__(self, config: Any = None) -> None:
        """`config`: a `Config`; by default one with its defaults."""
        self.config = config or self.Config()

    @abstractmethod
    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        """The object's canonical points, with colours, and its pose in every frame of the clip.

        It looks at the pixels of training frames only; see `training_frames`.

        Raises:
            HoigsError, ValueError: the clip, or a file, lacks what this initializer needs.
        """


def training_frames(clip: Clip) -> list[int]:
    """Positions whose pixels an initializer may look at: those that are not kept for tests."""
    return list(clip.split.get("train", ())) or list(range(len(clip)))


def check_track(track: ObjectTrack, frames: int) -> ObjectTrack:
    """`track`, if training can start from it.

    Raises:
        ValueError: too few points, values that are not finite, or poses for another frame count.
    """
    if len(track.points) < 4:
        raise ValueError(f"{len(track.points)} points are too few for an object; 4 is the least")
    if track.colors.shape != track.points.shape:
        raise ValueError(
            f"{len(track.points)} points have colours of shape {tuple(track.colors.shape)}"
        )
    for name in ("points", "colors", "rotations", "translations"):
        value = getattr(track, name)
        bad = int((~torch.isfinite(value)).reshape(len(value), -1).any(1).sum())
        if bad:
            raise ValueError(f"{name}: {bad} of {len(value)} rows are not finite")
    for name in ("rotations", "translations", "observed"):
        if len(getattr(track, name)) != frames:
            raise ValueError(
                f"{name} has {len(getattr(track, name))} rows, the clip has {frames} frames"
            )
    return track
