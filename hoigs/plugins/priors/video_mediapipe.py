"""prior:mediapipe: MediaPipe Pose, in an environment of its own.

mediapipe 0.10.21, the last wheel that carries its models, wants numpy below 2: it cannot live in
one environment with hoigs. So the user names a Python that has it, which runs a small script of
this package, frames in, one file out.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.video_prior import (
    Evidence,
    Landmarks,
    Progress,
    VideoPrior,
    VideoRequest,
    no_progress,
)
from hoigs.plugins.priors.video_subprocess import run_tool, settings_key

SCRIPT = Path(__file__).with_name("mediapipe_script.py")
INSTALL = (
    "make an environment for it: `python3.11 -m venv ENV && ENV/bin/pip install "
    "mediapipe==0.10.21`, and say `python: ENV/bin/python`"
)


class MediapipeConfig(ComponentConfig):
    """Settings of `prior:mediapipe`."""

    python: Path = Field(
        description="the Python of an environment with mediapipe, such as ENV/bin/python; "
        "relative to the video's folder"
    )
    complexity: int = Field(
        default=1, ge=0, le=2, description="of the model; 1 comes with mediapipe, it downloads 0, 2"
    )
    smooth: bool = Field(default=True, description="MediaPipe's filter over time")
    detection_confidence: float = Field(
        default=0.5, ge=0, le=1, description="below it a frame shows nobody"
    )
    tracking_confidence: float = Field(
        default=0.5, ge=0, le=1, description="below it the person is looked for anew"
    )


class MediapipePrior(VideoPrior):
    """Landmarks of the one person of a video by MediaPipe Pose.

    It follows a person from frame to frame and loses who jumps, so it is given every frame up to
    the last that is wanted, not only those that are.

    Args: as MediapipeConfig describes them.
    """

    provides = frozenset({"landmarks"})

    def __init__(
        self,
        python: str | Path,
        complexity: int = 1,
        smooth: bool = True,
        detection_confidence: float = 0.5,
        tracking_confidence: float = 0.5,
    ) -> None:
        self.python = Path(python)
        self.pose = {
            "model_complexity": complexity,
            "smooth_landmarks": smooth,
            "min_detection_confidence": detection_confidence,
            "min_tracking_confidence": tracking_confidence,
        }

    def commands(self) -> tuple[str, ...]:
        return (f"{self.python} -I {SCRIPT.name}",)

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Evidence:
        people = video.named("human") or ("human",)
        if len(people) > 1:
            raise HoigsError(
                f"prior:mediapipe finds one person, {len(people)} are asked for; run it on a video "
                "of each, or use prior:landmarks-files"
            )
        # not resolved further: an environment's python is a link, and the link is what counts
        python = video.resolve(self.python)
        if not python.exists():
            raise HoigsError(f"prior:mediapipe: there is no {python}; {INSTALL}")
        count = max(video.numbers, default=-1) + 1
        key = settings_key({"pose": self.pose, "frames": count})
        out = video.work / f"mediapipe-{key}.npz"
        if not out.is_file():
            self._run(python, out, count, video, progress)
        with np.load(out, allow_pickle=False) as file:
            image, world = (
                self._spread(file[k], count, video) for k in ("image_xyzv", "world_xyzv")
            )
        progress(1.0, "landmarks")
        text = f"MediaPipe Pose, complexity {self.pose['model_complexity']}"
        return Evidence(landmarks={people[0]: Landmarks(image, world, text)})

    def _run(
        self, python: Path, out: Path, count: int, video: VideoRequest, progress: Progress
    ) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        half = out.with_suffix(".part")
        settings = {
            "width": video.width, "height": video.height, "count": count,
            "pose": self.pose, "out": str(half.absolute()),
        }  # fmt: skip
        # -I: the script's own folder, where modules of hoigs lie, is not searched for imports
        argv = [str(python.absolute()), "-I", str(SCRIPT), json.dumps(settings)]
        log = out.with_suffix(".log")
        try:
            run_tool(argv, what="prior:mediapipe", log=log, images=_told(video, count, progress))
        except HoigsError as error:
            lacking = log.is_file() and "has no mediapipe" in log.read_text(errors="replace")
            raise HoigsError(f"{error}\n{INSTALL}" if lacking else str(error)) from error
        half.replace(out)

    def _spread(self, rows: np.ndarray, count: int, video: VideoRequest) -> np.ndarray:
        """The first rows among those of the whole video."""
        if rows.shape != (count, 33, 4):
            raise HoigsError(
                f"prior:mediapipe wrote an array of shape {rows.shape} for {count} frames; "
                "expected 33 landmarks of 4 numbers in each"
            )
        spread = np.full((video.frames, 33, 4), np.nan, np.float32)
        spread[:count] = rows
        return spread


def _told(video: VideoRequest, count: int, progress: Progress) -> Iterator[np.ndarray]:
    """The first frames, saying how far it is."""
    for i in range(count):
        progress(i / count, "landmarks")
        yield video.frame(i)
