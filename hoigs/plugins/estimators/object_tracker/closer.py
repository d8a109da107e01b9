"""A closer look at small and thin things: the part of the picture that they can reach, larger.

A cup of ten pixels in a large picture has five at the size at which objects are followed, and a
racket's strings none. What is held stays near the person, so that the part about them is read at
the video's own size at about the same cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    Estimates,
    FramePrompt,
    LazyFrames,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.footage import Footage
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask

ROOM = 0.35  # of the height of the part that shows people and the click, on each side of it
WORTH = 1.3  # by which a closer look enlarges at least

Part = tuple[int, int, int, int]  # of a video, pixels: left, upper, right and lower


def part_about(footage: Footage, masks: Sequence[PromptedMask], longest: int) -> Part | None:
    """The part of the video about all people and what was clicked, if any of that is fine; None
    where it is none, or where the part is no larger at `longest` pixels than the whole is here."""
    if footage.scale >= 1 or not any(m.fine for m in masks):
        return None
    shown = footage.person.any(0) | np.any([m.soft > 0.5 for m in masks], axis=0)
    rows, columns = (np.flatnonzero(shown.any(axis)) for axis in (1, 0))
    room = ROOM * (rows[-1] - rows[0])
    corners = np.array([columns[0] - room, rows[0] - room, columns[-1] + room, rows[-1] + room])
    h, w = footage.shape
    x0, y0, x1, y1 = (corners.clip(0, (w, h, w, h)) / footage.scale).round().astype(int).tolist()
    scale = min(1.0, longest / max(x1 - x0, y1 - y0))
    return (x0, y0, x1, y1) if scale > WORTH * footage.scale else None


def closer(video: VideoRequest, part: Part) -> VideoRequest:
    """A part of a video as a video of its own, with what is known and asked of it."""
    x0, y0, x1, y1 = part
    known = video.known
    if known is not None:
        masks, tracks = known.masks, known.landmarks
        if masks is not None:
            cut = {
                name: LazyFrames(video.frames, partial(_cut, each, part))
                for name, each in masks.entities.items()
            }
            masks = EntityMasks(cut)
        if tracks is not None:
            off = np.array((x0, y0, 0, 0), np.float32)
            tracks = {n: replace(t, image_xyzv=t.image_xyzv - off) for n, t in tracks.items()}
        known = Estimates(masks, tracks)
    return replace(
        video, width=x1 - x0, height=y1 - y0, known=known, video=None,
        read=lambda i: _cut([video.frame(i)], part, 0),
        entities=tuple(_moved(e, x0, y0) for e in video.entities),
    )  # fmt: skip


def _cut(frames: Sequence[Any], part: Part, i: int) -> np.ndarray:
    x0, y0, x1, y1 = part
    cut: np.ndarray = np.ascontiguousarray(frames[i][y0:y1, x0:x1])
    return cut


def _moved(entity: EntityRequest, x0: int, y0: int) -> EntityRequest:
    further = []
    for p in entity.prompts:
        points = tuple(PromptPoint(q.x - x0, q.y - y0, q.inside) for q in p.points)
        box = None
        if p.box is not None:
            box = (p.box[0] - x0, p.box[1] - y0, p.box[2] - x0, p.box[3] - y0)
        further.append(FramePrompt(p.frame, points, box))
    return replace(entity, points=(), box=None, further=tuple(further))
