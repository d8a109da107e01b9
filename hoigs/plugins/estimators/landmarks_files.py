"""estimator:landmarks-files: 2D or 3D landmarks of a person that any estimator has written."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import did_you_mean
from hoigs.core.interfaces.estimator import (
    Estimates,
    Estimator,
    Landmarks,
    VideoRequest,
)
from hoigs.core.progress import Progress, no_progress
from hoigs.plugins.estimators.common.frame_files import FileDiagnostics, absent
from hoigs.plugins.estimators.common.keypoints import read_landmarks

MADE_BY = (
    "Landmarks come from MediaPipe Pose (estimator:mediapipe writes pose_mediapipe.npz: "
    "image_xyzv and world_xyzv [frames, 33, 4]), or from ViTPose, OpenPose, MMPose or "
    "AlphaPose: one row or file a frame of the video."
)


class LandmarksFilesConfig(ComponentConfig):
    """Settings of `estimator:landmarks-files`."""

    path: Path = Field(
        default=Path("pose_mediapipe.npz"),
        description="file of the one person: pose_mediapipe.npz; an .npy or .npz of keypoints "
        "[F, 17|25|33|133, 3]; COCO results (.json); or a folder of one JSON file a frame "
        "(OpenPose, or lists of keypoints); relative to the video's folder",
    )
    people: dict[str, Path] = Field(
        default_factory=dict, description="person to file or folder, where there are several"
    )
    first_frame: int | None = Field(
        default=None, description="number of frame 0 in names and image ids; None: 0, or 1"
    )


class LandmarksFilesEstimator(Estimator):
    """Landmarks from files."""

    Config: ClassVar = LandmarksFilesConfig
    config: LandmarksFilesConfig
    provides = frozenset({"landmarks"})

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        problems = FileDiagnostics("estimator:landmarks-files", MADE_BY)
        tracks: dict[str, Landmarks] = {}
        for name, path in self._places(video, problems).items():
            place = video.resolve(path)
            if not place.exists():
                problems.add(f"{absent(place)}: the landmarks of {name}")
                continue
            track = read_landmarks(place, video, problems, self.config.first_frame)
            if track is not None:
                tracks[name] = track
        problems.raise_if_any()
        progress(1.0, "landmarks")
        return Estimates(landmarks=tracks)

    def _places(self, video: VideoRequest, problems: FileDiagnostics) -> dict[str, Path]:
        requested = video.named("human")
        if self.config.people:
            unknown = [name for name in self.config.people if requested and name not in requested]
            without = [name for name in requested if name not in self.config.people]
            for name in unknown:
                problems.add(f'people: "{name}" is not requested{did_you_mean(name, requested)}')
            for name in without:
                problems.add(f'people: no file for "{name}"')
            return self.config.people
        if len(requested) > 1:
            problems.add(f"{len(requested)} people are requested: name each one's file in `people`")
            return {}
        return {requested[0] if requested else "human": self.config.path}
