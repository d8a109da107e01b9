"""estimator:mediapipe: MediaPipe Pose, in an environment of its own.

mediapipe 0.10.21, the last wheel that contains its models, needs numpy below 2, which hoigs does
not. So the user names a Python that has it; it runs `mediapipe_script.py`, which reads frames from
standard input and writes one file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    Estimates,
    Estimator,
    Landmarks,
    VideoRequest,
)
from hoigs.core.progress import Progress, no_progress
from hoigs.plugins.estimators.common.subprocess import run_tool, settings_key

SCRIPT = Path(__file__).with_name("mediapipe_script.py")
INSTALL = (
    "make an environment for it: `python3.11 -m venv ENV && ENV/bin/pip install "
    "mediapipe==0.10.21`, and set `python: ENV/bin/python`"
)


class MediapipeConfig(ComponentConfig):
    """Settings of `estimator:mediapipe`."""

    python: Path = Field(
        description="the Python of an environment with mediapipe, such as ENV/bin/python; "
        "relative to the video's folder"
    )
    complexity: int = Field(
        default=1, ge=0, le=2, description="complexity of the model; mediapipe downloads 0 and 2"
    )
    smooth: bool = Field(default=True, description="use MediaPipe's filter over time")
    detection_confidence: float = Field(
        default=0.5, ge=0, le=1, description="confidence below which no person is found"
    )
    tracking_confidence: float = Field(
        default=0.5, ge=0, le=1, description="confidence below which the person is detected anew"
    )


class MediapipeEstimator(Estimator):
    """Landmarks of the one person of a video by MediaPipe Pose.

    It follows a person from frame to frame and loses one that jumps, so it is given every frame
    up to the last wanted one.
    """

    Config: ClassVar = MediapipeConfig
    config: MediapipeConfig
    provides = frozenset({"landmarks"})

    def _settings(self) -> dict[str, int | float]:
        """Arguments of `mediapipe.solutions.pose.Pose`."""
        return {
            "model_complexity": self.config.complexity,
            "smooth_landmarks": self.config.smooth,
            "min_detection_confidence": self.config.detection_confidence,
            "min_tracking_confidence": self.config.tracking_confidence,
        }

    def commands(self) -> tuple[str, ...]:
        return (f"{self.config.python} -I {SCRIPT.name}",)

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        people = video.named("human") or ("human",)
        if len(people) > 1:
            raise HoigsError(
                f"estimator:mediapipe finds one person, {len(people)} are requested; run it on a "
                "video of each, or use estimator:landmarks-files"
            )
        # links are not followed: the place of an environment's python, a link, selects it
        python = video.resolve(self.config.python)
        if not python.exists():
            raise HoigsError(f"estimator:mediapipe: there is no {python}; {INSTALL}")
        count = max(video.numbers, default=-1) + 1
        key = settings_key({"pose": self._settings(), "frames": count})
        out = video.work / f"mediapipe-{key}.npz"
        if not out.is_file():
            self._run(python, out, count, video, progress)
        with np.load(out, allow_pickle=False) as file:
            image, world = (
                self._spread(file[k], count, video) for k in ("image_xyzv", "world_xyzv")
            )
        progress(1.0, "landmarks")
        text = f"MediaPipe Pose, complexity {self.config.complexity}"
        return Estimates(landmarks={people[0]: Landmarks(image, world, text)})

    def _run(
        self, python: Path, out: Path, count: int, video: VideoRequest, progress: Progress
    ) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        half = out.with_suffix(".part")
        settings = {
            "width": video.width, "height": video.height, "count": count,
            "pose": self._settings(), "out": str(half.absolute()),
        }  # fmt: skip
        # -I: the script's own folder, where modules of hoigs lie, is not searched for imports
        argv = [str(python.absolute()), "-I", str(SCRIPT), json.dumps(settings)]
        log = out.with_suffix(".log")
        try:
            run_tool(
                argv, what="estimator:mediapipe", log=log, images=_frames(video, count, progress)
            )
        except HoigsError as error:
            lacking = log.is_file() and "has no mediapipe" in log.read_text(errors="replace")
            raise HoigsError(f"{error}\n{INSTALL}" if lacking else str(error)) from error
        half.replace(out)

    def _spread(self, rows: np.ndarray, count: int, video: VideoRequest) -> np.ndarray:
        """The first rows among those of the whole video."""
        if rows.shape != (count, 33, 4):
            raise HoigsError(
                f"estimator:mediapipe wrote an array of shape {rows.shape} for {count} frames; "
                "expected 33 landmarks of 4 numbers in each"
            )
        spread = np.full((video.frames, 33, 4), np.nan, np.float32)
        spread[:count] = rows
        return spread


def _frames(video: VideoRequest, count: int, progress: Progress) -> Iterator[np.ndarray]:
    """The first frames, reporting progress."""
    for i in range(count):
        progress(i / count, "landmarks")
        yield video.frame(i)
