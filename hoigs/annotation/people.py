"""The person's mask in one frame, by MediaPipe if its environment is installed."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from hoigs.annotation.video import ScrubbedVideo
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import EntityRequest, FramePrompt, VideoRequest
from hoigs.plugins.estimators.common.environments import MEDIAPIPE
from hoigs.plugins.estimators.mediapipe.estimator import MediapipeEstimator

KEPT = 40
NAME = "human"


class FoundPeople:
    """Finds the person in single frames, which takes some seconds each, and keeps the masks."""

    def __init__(self, video: ScrubbedVideo) -> None:
        self.video = video
        self._found: dict[int, tuple[FramePrompt | None, Bool[np.ndarray, "H W"]]] = {}
        self._lock = threading.Lock()

    @property
    def available(self) -> bool:
        return MEDIAPIPE.installed

    def known(self, frame: int) -> Bool[np.ndarray, "H W"] | None:
        """The mask, if the frame was looked at."""
        found = self._found.get(frame)
        return None if found is None else found[1]

    def find(self, frame: int, prompt: FramePrompt | None = None) -> Bool[np.ndarray, "H W"]:
        """The mask of the person at the prompt, without one of whom MediaPipe takes; empty where
        that is nobody.

        Raises:
            HoigsError: MediaPipe is not installed, finds nobody at the prompt, or failed.
        """
        with self._lock:
            found = self._found.get(frame)
            if found is None or prompt not in (None, found[0]):
                found = prompt, self._estimated(frame, prompt)
                while len(self._found) >= KEPT:
                    self._found.pop(next(iter(self._found)))
                self._found[frame] = found
            return found[1]

    def _estimated(self, frame: int, prompt: FramePrompt | None) -> Bool[np.ndarray, "H W"]:
        video = self.video
        points, box = ((), None) if prompt is None else (prompt.points, prompt.box)
        person = EntityRequest(NAME, "human", points=points, box=box)
        pixels = video.rgb(frame)
        with tempfile.TemporaryDirectory(prefix="hoigs-annotate-") as work:
            request = VideoRequest(
                frames=1, width=video.width, height=video.height, read=lambda _: pixels,
                folder=Path(work), work=Path(work), entities=(person,),
            )  # fmt: skip
            masks = MediapipeEstimator().estimate(request).masks
            if masks is None:
                raise HoigsError("MediaPipe gave no mask")
            return np.asarray(masks.entities[NAME][0])
