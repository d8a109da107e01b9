"""estimator:landmarks-files: 2D or 3D landmarks of a person that any estimator has written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import did_you_mean
from hoigs.core.interfaces.estimator import (
    BODY_25_LANDMARKS,
    COCO_17_LANDMARKS,
    Estimates,
    Estimator,
    Landmarks,
    VideoRequest,
    landmarks_from_keypoints,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.files import parse_json
from hoigs.plugins.estimators.frame_files import (
    FileDiagnostics,
    absent,
    load_array,
    npz_shapes,
    numbered,
    require_count,
    require_frames,
)

# Keypoints as estimators write them, read to MediaPipe's 33 landmarks.


# COCO-WholeBody: body, feet (left big toe, small toe, heel; right), 68 face points, 21 of each
# hand; MediaPipe has the knuckles of thumb, index and little finger
WHOLE_BODY_133 = [*COCO_17_LANDMARKS, *([-1] * 116)]
for _keypoint, _landmark in {
    17: 31, 19: 29, 20: 32, 22: 30, 93: 21, 96: 19, 108: 17, 114: 22, 117: 20, 129: 18,
}.items():  # fmt: skip
    WHOLE_BODY_133[_keypoint] = _landmark
CONVENTIONS: dict[int, tuple[str, tuple[int, ...]]] = {
    17: ("COCO-17", COCO_17_LANDMARKS),
    25: ("OpenPose BODY_25", BODY_25_LANDMARKS),
    33: ("BlazePose 33", tuple(range(33))),
    133: ("COCO-WholeBody", tuple(WHOLE_BODY_133)),
}
MOST_BYTES = 2**30  # of one JSON file: text of all keypoints of a long video
Person = Float[np.ndarray, "K 3"]


def read_landmarks(
    path: Path, video: VideoRequest, problems: FileDiagnostics, first_frame: int | None
) -> Landmarks | None:
    """The landmarks of one person; None when something was added to `problems`."""
    suffix = path.suffix.lower()
    if path.is_dir():
        people = _folder(path, video, problems, first_frame)
    elif suffix == ".json":
        people = _results(path, video, problems, first_frame)
    elif suffix in (".npz", ".npy"):
        return _arrays(path, video, problems)
    else:
        problems.add(f"{path}: expected .npz, .npy, .json or a folder of .json files")
        return None
    if people is None:
        return None
    counts = sorted({len(person) for frame in people.values() for person in frame})
    if not counts:
        problems.add(f"{path}: no person was found in any frame")
        return None
    if len(counts) > 1 or counts[0] not in CONVENTIONS:
        problems.add(f"{path}: {counts} keypoints a person, expected {_known()}")
        return None
    return _converted(_one_person(people, video.frames, counts[0]), path)


def _known() -> str:
    return " or ".join(f"{count} ({name})" for count, (name, _) in CONVENTIONS.items())


def _converted(keypoints: Float[np.ndarray, "F K 3"], path: Path) -> Landmarks:
    name, targets = CONVENTIONS[keypoints.shape[1]]
    return landmarks_from_keypoints(
        keypoints.astype(np.float32), targets, f"{name} keypoints of {path.name}"
    )


def _arrays(path: Path, video: VideoRequest, problems: FileDiagnostics) -> Landmarks | None:
    if path.suffix.lower() == ".npy":
        array = load_array(path, problems)
        return None if array is None else _keypoints(np.asarray(array), path, video, problems)
    shapes = npz_shapes(path, problems)
    if "image_xyzv" not in shapes:
        if len(shapes) == 1:
            with np.load(path, allow_pickle=False) as file:
                return _keypoints(file[next(iter(shapes))], path, video, problems)
        if shapes:
            problems.add(f"{path} holds {', '.join(shapes)}; expected image_xyzv and world_xyzv")
        return None
    good = True
    for key in ("image_xyzv", "world_xyzv"):
        shape = shapes.get(key, ((video.frames, 33, 4), None))[0]
        if shape[1:] != (33, 4):
            problems.add(f"{path}: {key} has shape {shape}, expected [frames, 33, 4]")
            good = False
        elif shape[0] != video.frames:
            require_count(shape[0], f"{path}: {key}", video, problems)
            good = False
    if not good:
        return None
    with np.load(path, allow_pickle=False) as file:
        image = file["image_xyzv"].astype(np.float32)
        world = file["world_xyzv"].astype(np.float32) if "world_xyzv" in shapes else None
    return Landmarks(image, world, f"MediaPipe Pose, {path.name}", to_hips=True)


def _keypoints(
    array: np.ndarray, path: Path, video: VideoRequest, problems: FileDiagnostics
) -> Landmarks | None:
    if array.ndim != 3 or array.shape[1] not in CONVENTIONS or array.shape[2] != 3:
        problems.add(
            f"{path}: an array of shape {array.shape}, expected [frames, keypoints, 3] of x, y, "
            f"score, with {_known()} keypoints"
        )
        return None
    require_count(len(array), path, video, problems)
    return _converted(array, path) if len(array) == video.frames else None


def _folder(
    folder: Path, video: VideoRequest, problems: FileDiagnostics, first_frame: int | None
) -> dict[int, list[Person]] | None:
    """One JSON a frame: OpenPose's, or the bare keypoints of one person (ExAvatar)."""
    files = numbered(folder, (".json",), video, problems, first_frame)
    if not files:
        return None
    require_frames(files, folder, video, problems)
    people = {}
    for i, path in files.items():
        data = _json(path, problems)
        if data is None:
            return None
        found = _people_of(data)
        if found is None:
            problems.add(
                f'{path}: expected OpenPose\'s {{"people": [{{"pose_keypoints_2d": …}}]}} or a '
                "list of [x, y, score]"
            )
            return None
        people[i] = found
    return people


def _people_of(data: Any) -> list[Person] | None:
    """The people in one frame's JSON; None when it is of no known form."""
    try:
        if isinstance(data, dict) and "people" in data:
            return [_person(person["pose_keypoints_2d"]) for person in data["people"]]
        if isinstance(data, list):
            return [_person(data)] if data else []
    except (KeyError, TypeError, ValueError):
        return None
    return None


def _person(values: Any) -> Person:
    """x, y, score of each keypoint, from a flat list or from triples."""
    return np.asarray(values, np.float64).reshape(-1, 3)


def _results(
    path: Path, video: VideoRequest, problems: FileDiagnostics, first_frame: int | None
) -> dict[int, list[Person]] | None:
    """COCO results [{image_id, keypoints}] (AlphaPose too), or MMPose's [{frame_id, instances}]."""
    data = _json(path, problems)
    if data is None:
        return None
    if isinstance(data, dict):
        data = data.get("instance_info", data.get("annotations"))
    people: dict[int, list[Person]] = {}
    try:
        for entry in data:
            if "instances" in entry:
                people[int(entry["frame_id"])] = [
                    np.column_stack((one["keypoints"], one["keypoint_scores"]))
                    for one in entry["instances"]
                ]
            else:
                number = _frame_of(entry["image_id"])
                people.setdefault(number, []).append(_person(entry["keypoints"]))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        problems.add(
            f"{path} is no list of COCO results ({{image_id, keypoints}}) nor of MMPose's "
            f"({{frame_id, instances}}): {type(error).__name__} {error}"
        )
        return None
    if first_frame is None:
        first_frame = 1 if people and 0 not in people and max(people) == video.frames else 0
    people = {number - first_frame: found for number, found in people.items()}
    outside = sorted(i for i in people if not 0 <= i < video.frames)
    if outside:
        problems.add(f"{path}: frames {outside[:8]} are not of this video of {video.frames}")
        return None
    return people


def _frame_of(image_id: int | str) -> int:
    """The frame of an image id: a number, or a name that ends in one."""
    if isinstance(image_id, int):
        return image_id
    digits = "".join(c if c.isdigit() else " " for c in Path(image_id).stem).split()
    return int(digits[-1])


def _json(path: Path, problems: FileDiagnostics) -> Any:
    try:
        return parse_json(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        problems.add(f"{path} is no readable JSON file: {error}")
        return None


def _one_person(
    people: dict[int, list[Person]], frames: int, count: int
) -> Float[np.ndarray, "F K 3"]:
    """One person over the video: at first the most certain one, then the nearest to the last."""
    track = np.full((frames, count, 3), np.nan)
    last: Person | None = None
    for i in sorted(people):
        if not people[i]:
            continue
        if last is None:
            chosen = max(people[i], key=lambda person: float(person[:, 2].sum()))
        else:
            distances = [_distance(person, last) for person in people[i]]
            chosen = people[i][distances.index(min(distances))]
        if (chosen[:, 2] > 0).any():
            track[i], last = chosen, chosen
    return track


def _distance(a: Person, b: Person) -> float:
    """Mean distance in pixels of the keypoints that both have; infinite without any."""
    both = (a[:, 2] > 0) & (b[:, 2] > 0)
    if not both.any():
        return float("inf")
    return float(np.linalg.norm(a[both, :2] - b[both, :2], axis=1).mean())


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
