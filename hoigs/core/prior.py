"""Priors: what is known before training has seen anything.

Two interfaces share the kind "prior": ObjectPrior, what an object looks like and where it is, and
hoigs.core.video_prior.VideoPrior, what estimators say of a video before it is a clip.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Self

import torch

from hoigs.core.clip import Clip, ObjectTrack

if TYPE_CHECKING:
    from hoigs.core.context import BuildContext


class Prior:
    """Anything that a spec names "prior:…"."""

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(**config.model_dump())


class ObjectPrior(Prior, ABC):
    """An object initialiser: a clip and the name of one of its objects in, an ObjectTrack out.

    A clip carries a track of its own for every object. A prior may keep that track's poses and
    bring better points, or place the object anew (HOIGS, Sec. "Object Initialization").
    """

    @abstractmethod
    def initialise(self, clip: Clip, entity: str) -> ObjectTrack:
        """The object's canonical points, with colours, and its pose in every frame of the clip.

        It looks at the pixels of training frames only; see `training_frames`.

        Raises:
            HoigsError, ValueError: the clip, or a file, lacks what this prior needs.
        """


def training_frames(clip: Clip) -> list[int]:
    """Positions whose pixels a prior may look at: those that are not kept for tests."""
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
