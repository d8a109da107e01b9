"""The person's mask in one frame, by MediaPipe if its environment is installed."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from hoigs.annotation.video import ScrubbedVideo
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import EntityRequest, VideoRequest
from hoigs.plugins.estimators.common.environments import MEDIAPIPE
from hoigs.plugins.estimators.mediapipe import MediapipeEstimator

KEPT = 40
NAME = "human"


class FoundPeople:
    """Finds the person in single frames, which takes some seconds each, and keeps the masks."""

    def __init__(self, video: ScrubbedVideo) -> None:
        self.video = video
        self._found: dict[int, Bool[np.ndarray, "H W"]] = {}
        self._lock = threading.Lock()

    @property
    def available(self) -> bool:
        return MEDIAPIPE.installed

    def known(self, frame: int) -> Bool[np.ndarray, "H W"] | None:
        """The mask, if the frame was looked at."""
        return self._found.get(frame)

    def find(self, frame: int) -> Bool[np.ndarray, "H W"]:
        """The mask, empty where nobody is found.

        Raises:
            HoigsError: MediaPipe is not installed, or failed.
        """
        with self._lock:
            if frame not in self._found:
                while len(self._found) >= KEPT:
                    self._found.pop(next(iter(self._found)))
                self._found[frame] = self._estimated(frame)
            return self._found[frame]

    def _estimated(self, frame: int) -> Bool[np.ndarray, "H W"]:
        video = self.video
        pixels = video.rgb(frame)
        with tempfile.TemporaryDirectory(prefix="hoigs-annotate-") as work:
            request = VideoRequest(
                frames=1, width=video.width, height=video.height, read=lambda _: pixels,
                folder=Path(work), work=Path(work), entities=(EntityRequest(NAME, "human"),),
            )  # fmt: skip
            masks = MediapipeEstimator().estimate(request).masks
            if masks is None:
                raise HoigsError("MediaPipe gave no mask")
            return np.asarray(masks.entities[NAME][0])
