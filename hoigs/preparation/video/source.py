"""What a video's folder holds beside the video: cameras, masks, tracks, landmarks."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import EstimateKind
from hoigs.core.spec.schema import ComponentSpec
from hoigs.core.system.colmap_files import PARTS, models_in
from hoigs.core.system.files import NotRegularError, did_you_mean_beside, name_from, regular_file
from hoigs.core.system.npz import holds

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
LANDMARKS = "pose_mediapipe.npz"
CAMERAS = "cameras.npz"
MEGASAM = frozenset({"images", "depths", "intrinsic", "cam_c2w"})  # arrays of its npz
VGGT = frozenset({"extrinsic", "intrinsic", "depth", "images"})  # likewise
FRAME_FOLDERS = ("frames", "images")  # where a folder of frames may keep them
_LAYOUT = """  FOLDER/
    video.mp4            the video (any name; one file), or frames/00000.png and so on
    pose_mediapipe.npz   image_xyzv and world_xyzv [F, 33, 4], from MediaPipe Pose; or a body of
                         GVHMR, WHAM, TRAM, PHALP (4D-Humans), PromptHMR or SAM 3D Body
    hoi_mask/00000.png   person and object together, 0/255, one file a video frame,
                         from a video segmenter; or masks/human/ and masks/object/ apart
    depth/               depth maps as .npz, in an array named metric_depth or disparity
    sparse/              a COLMAP model, or cameras.npz (K, world_to_camera, points, in metres),
                         or MegaSaM's or VGGT's npz, if you have one; else hoigs checks
                         whether the camera moves, and then runs structure from motion itself
    ball_track.npz       xyr [F, 3] pixels, if the object is a ball: centre and radius"""


class SourceError(HoigsError):
    """A video or its estimators that are absent, unreadable or do not fit together."""


class NobodyFoundError(SourceError):
    """No person is seen in any frame: nothing that was kept of this video is of use."""


@dataclass(frozen=True)
class Source:
    """Where each input of `prepare` lies.

    Attributes:
        video: the file, or the folder of frames. folder: where the other inputs lie.
        beside: estimators that read the files found there, of the kinds that no other estimator
            gives.
        masked: entities whose masks `beside` reads.
        colmap: folder of a COLMAP model, or None.
        cameras: cameras.npz, or MegaSaM's or VGGT's npz, or None. ball: ball_track.npz, or None.
        absent: which of "landmarks", "masks" (the person's) and "object" (the object's masks, or
            its track) are not there and given by no other estimator.
    """

    video: Path
    folder: Path
    beside: dict[EstimateKind, ComponentSpec] = field(default_factory=dict)
    masked: tuple[str, ...] = ()
    colmap: Path | None = None
    cameras: Path | None = None
    ball: Path | None = None
    absent: frozenset[str] = frozenset()


def clip_named_after(source: Path) -> Path:
    """Where the clip of a video, or of a folder with one, goes if nobody says: clips/ITS NAME."""
    return Path("clips") / name_from(source.name if source.is_dir() else source.stem, "mine")


def find_source(
    path: Path,
    *,
    people: Sequence[str] = ("human",),
    object_name: str = "object",
    given: Collection[str] = (),
    own_cameras: bool = False,
    complete: bool = True,
) -> Source:
    """The inputs in a folder, or beside a video file.

    Args:
        people: names of those who are looked for; none: no landmarks are needed.
        complete: landmarks and masks have to be there; False: `Source.absent` names those that are
            not.
        given: "masks", "landmarks" or "depth" that estimators give: no files are needed for them.
        own_cameras: cameras are made from the video: no COLMAP model is looked for.

    Raises:
        SourceError: naming everything that is absent and who makes it.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(
            f"{path} does not exist{did_you_mean_beside(path)} expected a video, or a folder with "
            "one"
        )
    if not path.is_dir():
        require_regular(path)
    folder = path if path.is_dir() else path.parent
    missing: list[str] = []
    video = path if path.is_file() else _find_video(folder, missing)
    if video is not None and video.is_file() and not video.stat().st_size:
        raise SourceError(f"{video} is empty: 0 bytes; copy it again")
    beside: dict[EstimateKind, ComponentSpec] = {}
    absent: set[str] = set()
    wanted = bool(people) and "landmarks" not in given
    if people and (folder / LANDMARKS).is_file():
        beside["landmarks"] = _files("landmarks", LANDMARKS)
    elif wanted and not complete:
        absent.add("landmarks")
    elif wanted:
        missing.append(
            "pose_mediapipe.npz: body landmarks, from MediaPipe Pose (`pip install mediapipe` in "
            "an environment of its own), arrays image_xyzv and world_xyzv [F, 33, 4]; or let hoigs "
            "find them: --estimators offline"
        )
    masked: tuple[str, ...] = ()
    ball = folder / "ball_track.npz"
    if "masks" not in given:
        lacking: list[str] = []
        spec, masked = _find_masks(folder, people, object_name, lacking)
        if masked or complete:
            beside["masks"] = spec
        if complete:
            missing += lacking
        else:
            absent |= {"masks"} if set(people) - set(masked) else set()
    if object_name not in masked and not ball.is_file():
        absent.add("object")
    if (folder / "depth").is_dir():
        beside["depth"] = _files("depth", "depth")
    colmap = None if own_cameras else _find_colmap(folder, missing)
    cameras = None if own_cameras else _find_cameras(folder)
    if missing:
        lines = "\n".join(f"  - {line}" for line in missing)
        raise SourceError(
            f"{path} cannot be prepared; absent:\n{lines}\n"
            "Estimators' files are read from one folder, or from where estimators read them "
            f"(`hoigs plugins` lists them):\n{_LAYOUT}"
        )
    assert video is not None
    beside = {kind: spec for kind, spec in beside.items() if kind not in given}
    return Source(
        video,
        folder,
        beside,
        masked,
        colmap,
        cameras,
        ball if ball.is_file() else None,
        frozenset(absent - set(given)),
    )


def _files(kind: EstimateKind, path: str, **settings: Any) -> ComponentSpec:
    return ComponentSpec(use=f"estimator:{kind}-files", path=path, **settings)


def require_regular(path: Path) -> None:
    """A pipe or a device is refused: reading one waits, and frames are read more than once.

    Raises:
        SourceError: something is there that is no regular file.
    """
    if not path.exists():
        return  # whoever opens it says so
    try:
        regular_file(path)
    except NotRegularError as error:
        raise SourceError(f"{path} {error}: copy its content to a file") from error


def find_video(path: Path) -> Path | None:
    """The video of a source, or its folder of frames; None if it has neither.

    Raises:
        SourceError: there are several videos.
    """
    if path.is_file():
        return path
    return _find_video(path, []) if path.is_dir() else None


def _find_video(folder: Path, missing: list[str]) -> Path | None:
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) > 1:
        names = ", ".join(p.name for p in videos)
        raise SourceError(f"{folder} holds {len(videos)} videos ({names}): name the one to prepare")
    if videos:
        return videos[0]
    for frames in (folder, *(folder / name for name in FRAME_FOLDERS)):
        if frames.is_dir() and numbered_frames(frames):
            return frames
    missing.append(
        f"a video ({', '.join(VIDEO_SUFFIXES)}) from your camera, or its frames as numbered images "
        f"({', '.join(IMAGE_SUFFIXES)}), there or in {' or '.join(FRAME_FOLDERS)}/"
    )
    return None


def _find_masks(
    folder: Path, people: Sequence[str], object_name: str, missing: list[str]
) -> tuple[ComponentSpec, tuple[str, ...]]:
    """The estimator that reads them, and the entities that it reads."""
    names = (*people, object_name)
    apart = tuple(n for n in names if (folder / "masks" / n).is_dir())
    together = folder / "hoi_mask"
    one = len(people) == 1  # whom it can be separated from the object by
    if one and apart != names and together.is_dir() and any(together.glob("*.png")):
        return _files("masks", "hoi_mask", holds="together", resize=True), names
    for name in names:
        # a tracked ball gives the object's mask, so the person's alone is enough
        covered = name == object_name and (folder / "ball_track.npz").is_file()
        if name not in apart and not covered:
            missing.append(
                f"masks/{name}/00000.png, …: from a video segmenter such as SAM 2, one file a "
                "video frame, 0/255 (or hoi_mask/ with person and object together)"
            )
    return _files("masks", "masks", resize=True), apart


def _find_colmap(folder: Path, missing: list[str]) -> Path | None:
    sparse = folder / "sparse"
    if not sparse.is_dir():
        return None
    whole = {
        sparse / name: count
        for name, count in models_in(sparse).items()
        if any(
            all((sparse / name / (part + suffix)).is_file() for part in PARTS)
            for suffix in (".bin", ".txt")
        )
    }
    if whole:
        return max(whole, key=lambda model: whole[model])
    missing.append(
        "sparse/{cameras,images,points3D}.bin: the folder is there but no COLMAP model is in it; "
        "run `colmap mapper`, or delete the folder, or use --camera sfm or static"
    )
    return None


def _find_cameras(folder: Path) -> Path | None:
    """cameras.npz, or else the one file that holds arrays of MegaSaM or VGGT, whatever its name."""
    if (folder / CAMERAS).is_file():
        return folder / CAMERAS
    files = sorted(folder.glob("*.npz"))
    found = [path for path in files if holds(path, MEGASAM) or holds(path, VGGT)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise SourceError(f"{folder} holds cameras of MegaSaM or VGGT in {names}: leave one there")
    return found[0] if found else None


def numbered_frames(folder: Path) -> list[Path]:
    """The images of a folder in the order of the number that their names end in."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(paths, key=lambda p: (frame_number(p.name) or 0, p.name))


def frame_number(name: str) -> int | None:
    """The last number in a file's name: 17 of frame_00017.png."""
    digits = "".join(c if c.isdigit() else " " for c in Path(name).stem).split()
    return int(digits[-1]) if digits else None
