"""reader:behave: sequences of BEHAVE (Bhatnagar 2022): Kinects, SMPL+H and object fits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.smpl_params import pose_from_smplh, same_betas
from hoigs.core.system.npz import load_arrays
from hoigs.core.system.unpickling import load_pickle
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import (
    BodyTrack,
    Clip,
    FrameStore,
    ObjectTrack,
    OverStore,
    uniform_test_split,
)
from hoigs.core.values.lens import Lens
from hoigs.core.values.tokens import EntityKind
from hoigs.plugins.readers.checked_files import (
    Need,
    ReaderConfig,
    entry,
    numbers,
    parse_json,
    require_files,
)
from hoigs.plugins.readers.lazy_frames import (
    DepthFiles,
    LazyFrames,
    MaskFiles,
    PixelFiles,
    video_moments,
)
from hoigs.plugins.readers.points import (
    checked_rotation,
    points_along_rays,
    points_of_depth,
    rigid,
    sample_template,
)

# BEHAVE's registrations: a pickle for each frame (1 fps), or arrays by time (30 fps).

SITE = "https://virtualhumans.mpi-inf.mpg.de/behave"
MAKER = (
    f"Sequences of {SITE} have a fit in each frame; or put smpl_fit_all.npz and object_fit_all.npz "
    "of its 30-fps release into the sequence"
)
SAME_TIME = 0.005  # seconds; frames at 30 fps are 0.033 apart


@dataclass(frozen=True)
class Fits:
    """Registrations of the frames that have them.

    Attributes:
        frames: folders, in order. poses: axis-angle, 52 joints. places, object_places: metres, in
            the world of Kinect 1. needs: files that are absent, if no frame is registered.
    """

    frames: list[Path]
    poses: Float[Tensor, "F 156"]
    places: Float[Tensor, "F 3"]
    betas: Float[Tensor, "F 10"]
    object_turns: Float[Tensor, "F 3"]
    object_places: Float[Tensor, "F 3"]
    source: str
    gender: str | None = None
    needs: tuple[Need, ...] = ()


def object_names(category: str) -> tuple[str, ...]:
    """What the folder of an object's fits may be called (data/seq_utils.py: get_obj_name)."""
    detected = {"chair": "chair", "ball": "sports ball"}
    return (category, *(v for k, v in detected.items() if k in category and v != category))


def read_fits(folder: Path, frames: Sequence[Path], category: str) -> Fits:
    """The fits of a sequence, from its frames if any of them has one, else from its arrays.

    Raises:
        ClipError: a file is damaged or has another layout.
    """
    pairs = {frame: _files(frame, category) for frame in frames}
    if any(None not in pair for pair in pairs.values()):
        return _of_frames({f: p for f, p in pairs.items() if None not in p})
    body_path, object_path = folder / "smpl_fit_all.npz", folder / "object_fit_all.npz"
    if body_path.is_file() or object_path.is_file():
        gone = [p.name for p in (body_path, object_path) if not p.is_file()]
        absent = tuple(Need.of(name, maker=MAKER) for name in gone)
        return _none(frames, absent) if absent else _of_arrays(frames, body_path, object_path)
    needs = []
    for frame in frames:
        person, item = _paths(frame, category)
        needs += [Need.of(*names, maker=MAKER) for names in (person, item)]
    return _none(frames, tuple(needs))


def _paths(frame: Path, category: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    person = (f"{frame.name}/person/fit02/person_fit.pkl",)
    return person, tuple(f"{frame.name}/{n}/fit01/{n}_fit.pkl" for n in object_names(category))


def _files(frame: Path, category: str) -> tuple[Path | None, ...]:
    return tuple(Need.of(*n, maker=MAKER).found(frame.parent) for n in _paths(frame, category))


def _none(frames: Sequence[Path], needs: tuple[Need, ...]) -> Fits:
    empty = torch.zeros(0, 3)
    poses, betas = torch.zeros(0, 156), torch.zeros(0, 10)
    return Fits(list(frames), poses, empty, betas, empty, empty, "", needs=needs)


def _of_frames(pairs: Mapping[Path, Any]) -> Fits:
    rows: dict[str, list[np.ndarray]] = {k: [] for k in ("pose", "trans", "betas", "angle", "at")}
    for person, item in pairs.values():
        body, track = load_pickle(person), load_pickle(item)
        for key, width in (("pose", 156), ("trans", 3), ("betas", 10)):
            rows[key].append(_numbers(body, key, width, person))
        rows["angle"].append(_numbers(track, "angle", 3, item))
        rows["at"].append(_numbers(track, "trans", 3, item))
    poses, places, betas, turns, at = (torch.from_numpy(np.stack(r)) for r in rows.values())
    return Fits(list(pairs), poses, places, betas, turns, at, "fit02 and fit01 of each frame")


def _of_arrays(frames: Sequence[Path], body_path: Path, object_path: Path) -> Fits:
    """Rows are found by time: the release leaves out frames that could not be registered."""
    try:
        body, track = load_arrays(body_path), load_arrays(object_path)
    except ValueError as error:
        raise ClipError(f"{body_path.parent}: 30-fps fits: {error}") from error
    widths = {"poses": 156, "trans": 3, "betas": 10}
    of_object = {"angles": 3, "trans": 3}
    for path, table, keys in ((body_path, body, widths), (object_path, track, of_object)):
        count = len(table.get("frame_times", ()))
        bad = [k for k, w in keys.items() if k not in table or table[k].shape != (count, w)]
        if bad or not count:
            raise ClipError(f"{path}: expected {keys} numbers for each of frame_times; see {bad}")
    of_body, of_track = _seconds_of_fit(body["frame_times"]), _seconds_of_fit(track["frame_times"])
    kept, rows, others = [], [], []
    for frame in frames:
        now = float(frame.name[1:])
        row, other = (int(np.abs(t - now).argmin()) for t in (of_body, of_track))
        if max(abs(of_body[row] - now), abs(of_track[other] - now)) <= SAME_TIME:
            kept.append(frame)
            rows.append(row)
            others.append(other)
    if not kept:
        raise ClipError(
            f"{body_path}: none of its times {of_body[0]:.3f} … {of_body[-1]:.3f} s is one of the "
            f"frames {frames[0].name} … {frames[-1].name}; are the fits of this sequence?"
        )
    poses, places, betas = (torch.from_numpy(body[k][rows].astype(np.float64)) for k in widths)
    turns, at = (torch.from_numpy(track[k][others].astype(np.float64)) for k in ("angles", "trans"))
    gender = str(body["gender"]) if "gender" in body else None
    source = "smpl_fit_all.npz and object_fit_all.npz"
    return Fits(kept, poses, places, betas, turns, at, source, gender)


def _seconds_of_fit(times: np.ndarray) -> np.ndarray:
    """Seconds of "t0003.033", or of numbers.

    Raises:
        ClipError: they are something else.
    """
    texts = [str(t).removeprefix("t") for t in times]
    return numbers(np.array(texts, object), "frame_times", -1)


def _numbers(table: Any, key: str, width: int, path: Path) -> np.ndarray:
    return numbers(entry(table, key, str(path)), f"{path}: {key}", width, flat=True)


# BEHAVE's JSON files: a sequence's info, a Kinect's lens and its place.

ShortText = Annotated[str, Field(max_length=1000)]  # no path or word is longer


class SequenceInfo(BaseModel):
    """info.json; config and intrinsic are relative to the sequence."""

    config: ShortText
    intrinsic: ShortText
    cat: ShortText
    gender: ShortText | None = None


class ColorCalibration(BaseModel):
    """The colour camera. opencv: fx, fy, cx, cy in some order, then the distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    opencv: list[float]

    def lens(self) -> Lens:
        """OpenCV's calibration: pixel centres are at whole numbers."""
        K = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        return Lens.opencv(K, self.opencv[4:], self.width, self.height, pixel_center=0.0)


class Calibration(BaseModel):
    """intrinsics/K/calibration.json."""

    color: ColorCalibration


class KinectPose(BaseModel):
    """config/K/config.json: colour camera to the world, which is Kinect 1's colour camera."""

    rotation: list[float]
    translation: list[float]

    def world_to_camera(self, where: str) -> np.ndarray:
        if (len(self.rotation), len(self.translation)) != (9, 3):
            raise ClipError(f"{where}: expected 9 numbers of rotation and 3 of translation")
        turn = checked_rotation(np.reshape(self.rotation, (3, 3)), where)
        return rigid(turn.T, -turn.T @ np.array(self.translation))


LAYOUT = "a BEHAVE sequence"
SEQUENCES, CALIBRATION = f"Sequences of {SITE}", f"calibs.zip of {SITE}, beside sequences/"
FRAMES = f"{SEQUENCES}, or `tools/video2images.py VIDEO` of xiexh20/behave-dataset from the videos"
MASKS = (
    f"{SEQUENCES}; those at 1 fps have masks, frames taken from videos need your segmenter, or "
    "`--reader-set masks=false`"
)
FRAME = re.compile(r"t(\d+\.\d+)")
SPAN = (1.0, 6.0)  # metres from a Kinect, where a sequence has no depth
GENDERS = {f"Sub{i:02d}": "male" if i < 6 else "female" for i in range(1, 9)}  # data/const.py


class BehaveConfig(ReaderConfig):
    """Settings of reader:behave."""

    kinect: int = Field(default=1, ge=0, le=3, description="the one that is trained on")
    held_out: bool = Field(default=True, description="the others are held-out views, if there")
    masks: bool = Field(default=True, description="False reads frames without masks: scene only")
    points: int = Field(default=20_000, ge=1, description="scene points to start from")
    object_points: int = Field(default=5_000, ge=4, description="on the object's template")


class BehaveReader(ClipReader):
    """One Kinect's colour frames, undistorted, in the world of Kinect 1, in metres.

    Frames are the folders tSSSS.mmm of a sequence; poses are the fits in them, or those of
    smpl_fit_all.npz and object_fit_all.npz (30 fps) with the same frame_times. A frame without a
    registration is left out. The object is its simplified template about the mean of its vertices.
    Kinect 1's world is tilted against the floor: no axis is up.
    """

    Config: ClassVar = BehaveConfig
    config: BehaveConfig

    def matches(self, folder: Path) -> bool:
        folder = Path(folder)
        return (folder / "info.json").is_file() or bool(_frame_folders(folder))

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        frames = _frame_folders(folder)
        needs = [Need.of("info.json", maker=SEQUENCES)]
        if not frames:
            needs.append(Need.of("t0003.000/", maker=FRAMES))
        require_files(folder, LAYOUT, needs)
        info = parse_json(folder / "info.json", SequenceInfo)
        fits = read_fits(folder, frames, info.cat) if self.config.masks else None
        kept = frames if fits is None else fits.frames
        needs = [
            *self._view_needs(info, kept, self.config.kinect),
            *(template_needs(info.cat) if self.config.masks else ()),
            *(fits.needs if fits else ()),
        ]
        require_files(folder, LAYOUT, needs)
        both: dict[str, EntityKind] = {"human": "human", "object": "object"}
        kinds = both if self.config.masks else {}
        bodies, objects = self._tracks(folder, info, fits) if fits else ({}, {})
        view = self._view(folder, info, kept, self.config.kinect)
        span = points_of_depth(view.store, view.cameras, tuple(kinds), self.config.points)
        points, colors = span or points_along_rays(
            view.store, view.cameras, tuple(kinds), SPAN, self.config.points
        )
        times = np.array([_seconds(f) for f in kept])
        moments = video_moments(range(len(kept)), len(kept), bodies)
        shared: dict[str, Any] = {
            "kinds": kinds,
            "bodies": bodies,
            "objects": objects,
            "points": points,
            "point_colors": colors,
            "fps": float(1 / np.median(np.diff(times))) if len(kept) > 1 else 1.0,
            "depth_kind": "metric" if view.store.depth(0) is not None else "none",
        }
        others = self._others(folder, info, kept) if self.config.held_out else {}
        provenance = {
            "reader": "reader:behave",
            "cameras": f"Kinect {self.config.kinect}, undistorted; "
            "world of Kinect 1, tilted to the floor",
            "held out": [f"Kinect {k}" for k in others],
            "points": "depth images" if span else f"random, {SPAN[0]:g} to {SPAN[1]:g} m away",
            "frame_times": times.tolist(),
            "without registration": sorted({f.name for f in frames} - {f.name for f in kept}),
        }
        return Clip(
            name=folder.resolve().name,
            store=view.store,
            cameras=view.cameras,
            moments=moments,
            split=uniform_test_split(len(kept)),
            held_out=_joined(others, moments, shared) if others else None,
            provenance=provenance,
            **shared,
        )

    def _view_needs(self, info: SequenceInfo, frames: Sequence[Path], kinect: int) -> list[Need]:
        own = f"{info.intrinsic}/{kinect}/calibration.json"
        needs = [Need.of(f"{info.config}/{kinect}/config.json", maker=CALIBRATION)]
        needs.append(Need.of(own, maker=CALIBRATION))
        for frame in frames:
            place = f"{frame.name}/k{kinect}"
            needs.append(Need.of(f"{place}.color.jpg", f"{place}.color.png", maker=FRAMES))
            if self.config.masks:
                needs += [Need.of(*names, maker=MASKS) for names in _mask_names(place).values()]
        return needs

    def _view(self, folder: Path, info: SequenceInfo, frames: Sequence[Path], kinect: int) -> _View:
        path = folder / info.intrinsic / str(kinect) / "calibration.json"
        calibration = parse_json(path, Calibration)
        pose = parse_json(folder / info.config / str(kinect) / "config.json", KinectPose)
        lens = calibration.color.lens()
        camera = lens.camera(pose.world_to_camera(f"{info.config}/{kinect}/config.json"))
        images: list[Path] = []
        masks: dict[str, list[Path | None]] = {"human": [], "object": []}
        depths: list[Path | None] = []
        for frame in frames:
            place = f"{frame.name}/k{kinect}"
            images.append(_found(folder, f"{place}.color.jpg", f"{place}.color.png"))
            depth = folder / f"{place}.depth.png"
            depths.append(depth if depth.is_file() else None)
            for name, names in _mask_names(place).items():
                masks[name].append(_found(folder, *names) if self.config.masks else None)
        cameras, lenses = [camera] * len(frames), [lens] * len(frames)
        pixels = PixelFiles(
            images,
            masks={n: MaskFiles(p) for n, p in masks.items()} if self.config.masks else None,
            depth=DepthFiles(depths, scale=0.001) if any(depths) else None,
        )
        store = LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb)
        return _View(store, cameras)

    def _others(self, folder: Path, info: SequenceInfo, frames: Sequence[Path]) -> dict[int, _View]:
        """Views of those other Kinects whose files are complete."""
        kinects = [k for k in range(4) if k != self.config.kinect]
        return {
            k: self._view(folder, info, frames, k)
            for k in kinects
            if all(need.found(folder) for need in self._view_needs(info, frames, k))
        }

    def _tracks(
        self, folder: Path, info: SequenceInfo, fits: Fits
    ) -> tuple[dict[str, BodyTrack], dict[str, ObjectTrack]]:
        betas = same_betas(list(fits.betas), f"{folder}: SMPL+H fits")
        pose = pose_from_smplh(fits.poses, fits.places, betas, "flat")
        subject = next((s for s in GENDERS if s in folder.resolve().name.split("_")), None)
        gender = info.gender or fits.gender or (GENDERS[subject] if subject else None)
        source = f"{fits.source}; SMPL+H"
        body = BodyTrack("body:smplh", pose.to(torch.float32), source, gender=gender)
        mesh = next(path for n in template_needs(info.cat) if (path := n.found(folder)))
        points, colors = sample_template(mesh, self.config.object_points)
        track = ObjectTrack(
            points=points,
            colors=colors,
            rotations=axis_angle_to_matrices(fits.object_turns).float(),
            translations=fits.object_places.float(),
            observed=torch.ones(len(fits.frames), dtype=torch.bool),
            provenance=f"{fits.source}; {mesh.name}",
        )
        return {"human": body}, {"object": track}


@dataclass(frozen=True)
class _View:
    store: FrameStore
    cameras: list[Camera]


class _Chain(OverStore):
    """Several stores one after the other."""

    def __init__(self, stores: Sequence[FrameStore], length: int) -> None:
        super().__init__(stores[0])
        self.stores, self.length = stores, length

    def _at(self, position: int) -> tuple[FrameStore, int]:
        view, place = divmod(position, self.length)
        return self.stores[view], place


def _joined(views: Mapping[int, _View], moments: Sequence[Any], shared: dict[str, Any]) -> Clip:
    count = len(moments) * len(views)
    return Clip(
        name="held out",
        store=_Chain([v.store for v in views.values()], len(moments)),
        cameras=[c for v in views.values() for c in v.cameras],
        moments=list(moments) * len(views),
        split={"train": [], "test": list(range(count))},
        **shared,
    )


def template_needs(category: str) -> list[Need]:
    """The simplified mesh of the registrations, whose name contains its number of faces."""
    prefix = f"../../objects/{category}/{category}"
    sizes = ("f1000", "f2500", "f2000", "closed_f1000")
    return [Need.of(*(f"{prefix}_{s}.ply" for s in sizes), maker=f"objects.zip of {SITE}")]


def _mask_names(place: str) -> dict[str, tuple[str, ...]]:
    person = tuple(f"{place}.person_mask.{s}" for s in ("png", "jpg"))
    item = tuple(f"{place}.{n}.{s}" for n in ("obj_rend_mask", "obj_mask") for s in ("png", "jpg"))
    return {"human": person, "object": item}


def _frame_folders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if FRAME.fullmatch(p.name) and p.is_dir()]
    return sorted(found, key=_seconds)


def _seconds(frame: Path) -> float:
    return float(frame.name[1:])


def _found(folder: Path, *names: str) -> Path:
    path = Need.of(*names, maker="").found(folder)
    assert path is not None  # require_files has found it
    return path
