"""Masks that a preparation has found in all frames, read from its work folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from hoigs.preparation.estimates.reader import FoundObject, RawEstimates
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.prepare import work_folder
from hoigs.preparation.saved import from_result
from hoigs.preparation.stages.work_folder import Result, WorkFolder
from hoigs.preparation.video.frames import FrameList


class TrackedMasks:
    """By entity, the mask in each frame of the video that was tracked.

    Attributes:
        confidence: of each entity by frame, 0..1, or 1 where its estimator gives none; 0: it is not
            seen. None: not tracked there.

    Args:
        out: the clip of the preparation; `object_name`, `human` are the entities' names in it.
    """

    def __init__(self, out: Path, object_name: str, human: str) -> None:
        self._stacks: dict[str, MaskStack] = {}
        self._rows: dict[int, int] = {}
        self.confidence: dict[str, list[float | None]] = {}
        root = work_folder(out)
        frames = _result(root, "frames")
        if not isinstance(frames, FrameList):
            return
        self._rows = {number: row for row, number in enumerate(frames.indices)}
        evidence, found = _result(root, "evidence"), _result(root, "object_masks")
        if isinstance(evidence, RawEstimates):
            masks = evidence.masks
            people = masks.human if masks.human is not None else masks.together
            for name, stack in ((human, people), (object_name, masks.object)):
                if stack is not None:
                    self._stacks[name] = stack
            for name, person in evidence.further.items():
                self._stacks[name] = person.masks
        sure: dict[str, np.ndarray | None] = {}
        if isinstance(found, FoundObject):
            for name, thing in {object_name: found, **found.further}.items():
                self._stacks[name], sure[name] = thing.masks, thing.confidence
        for name, stack in self._stacks.items():
            seen = stack.bits.any(axis=(1, 2)).astype(float)
            given = sure.get(name)
            self.confidence[name] = _by_frame(seen if given is None else given * seen, self._rows)

    def names(self) -> list[str]:
        """Entities that have masks."""
        return list(self._stacks)

    def mask(self, name: str, frame: int) -> Bool[np.ndarray, "H W"] | None:
        """The mask at the size of the prepared frames; None where there is none."""
        stack, row = self._stacks.get(name), self._rows.get(frame)
        return None if stack is None or row is None or row >= len(stack) else stack[row]


def _result(root: Path, stage: str) -> Any:
    """A stage's last result, whatever it was made from; None if there is none."""
    try:
        content = json.loads((root / stage / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    stored = WorkFolder(root).load(stage, content["key"])
    if stored is None or "made" not in stored.values:
        return None
    return from_result(Result(stored.values["made"], stored.arrays))


def _by_frame(values: np.ndarray, rows: dict[int, int]) -> list[float | None]:
    """By frame of the video, rounded for the page; None where it was not tracked."""
    count = max(rows, default=-1) + 1
    found: list[float | None] = [None] * count
    for frame, row in rows.items():
        if row < len(values) and np.isfinite(values[row]):
            found[frame] = round(float(values[row]), 2)
    return found
