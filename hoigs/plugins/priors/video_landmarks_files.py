"""prior:landmarks-files: 2D or 3D landmarks of a person that any estimator has written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import did_you_mean
from hoigs.core.video_prior import (
    Evidence,
    Landmarks,
    Progress,
    VideoPrior,
    VideoRequest,
    no_progress,
)
from hoigs.plugins.priors.video_files import Problems, absent
from hoigs.plugins.priors.video_keypoints import read_landmarks

MADE_BY = (
    "Landmarks come from MediaPipe Pose (prior:mediapipe writes pose_mediapipe.npz: image_xyzv and "
    "world_xyzv [frames, 33, 4]), or from ViTPose, OpenPose, MMPose or AlphaPose: one row or file "
    "a frame of the video."
)


class LandmarksFilesConfig(ComponentConfig):
    """Settings of `prior:landmarks-files`."""

    path: Path = Field(
        default=Path("pose_mediapipe.npz"),
        description="of the person asked for: pose_mediapipe.npz; an .npy or .npz of keypoints "
        "[F, 17|25|33|133, 3]; COCO results (.json); or a folder of one JSON file a frame "
        "(OpenPose, or lists of keypoints); relative to the video's folder",
    )
    people: dict[str, Path] = Field(
        default_factory=dict, description="person to file or folder, where there are several"
    )
    first_frame: int | None = Field(
        default=None, description="number of frame 0 in names and image ids; None: 0, or 1"
    )


class LandmarksFilesPrior(VideoPrior):
    """Landmarks from files.

    Args: as LandmarksFilesConfig describes them.
    """

    provides = frozenset({"landmarks"})

    def __init__(
        self,
        path: str | Path = "pose_mediapipe.npz",
        people: Mapping[str, str | Path] | None = None,
        first_frame: int | None = None,
    ) -> None:
        self.path, self.first_frame = Path(path), first_frame
        self.people = {name: Path(p) for name, p in (people or {}).items()}

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Evidence:
        problems = Problems("prior:landmarks-files", MADE_BY)
        tracks: dict[str, Landmarks] = {}
        for name, path in self._places(video, problems).items():
            place = video.resolve(path)
            if not place.exists():
                problems.add(f"{absent(place)}: the landmarks of {name}")
                continue
            track = read_landmarks(place, video, problems, self.first_frame)
            if track is not None:
                tracks[name] = track
        problems.raise_if_any()
        progress(1.0, "landmarks")
        return Evidence(landmarks=tracks)

    def _places(self, video: VideoRequest, problems: Problems) -> dict[str, Path]:
        asked = video.named("human")
        if self.people:
            unknown = [name for name in self.people if asked and name not in asked]
            without = [name for name in asked if name not in self.people]
            for name in unknown:
                problems.add(f'people: nobody asks for "{name}"{did_you_mean(name, asked)}')
            for name in without:
                problems.add(f'people: no file for "{name}"')
            return self.people
        if len(asked) > 1:
            problems.add(f"{len(asked)} people are asked for: name each one's file in `people`")
            return {}
        return {asked[0] if asked else "human": self.path}
