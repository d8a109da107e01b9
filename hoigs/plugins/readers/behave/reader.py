"""reader:behave: sequences of BEHAVE (Bhatnagar 2022): Kinects, SMPL+H and object fits."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field

from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.smpl_params import pose_from_smplh, same_betas
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack, uniform_test_split
from hoigs.core.values.tokens import EntityKind
from hoigs.plugins.readers.behave.calibration import Calibration, KinectPose, SequenceInfo
from hoigs.plugins.readers.behave.fits import Fits, read_fits
from hoigs.plugins.readers.common.config import ReaderConfig
from hoigs.plugins.readers.common.frame_order import video_moments
from hoigs.plugins.readers.common.json_file import parse_json
from hoigs.plugins.readers.common.lazy_frames import DepthFiles, LazyFrames, MaskFiles
from hoigs.plugins.readers.common.listing import Need, require_files
from hoigs.plugins.readers.common.start_points import points_along_rays, points_of_depth
from hoigs.plugins.readers.common.template_mesh import sample_template

LAYOUT = "a BEHAVE sequence"
SITE = "https://virtualhumans.mpi-inf.mpg.de/behave"
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
        kinds: dict[str, EntityKind] = (
            {"human": "human", "object": "object"} if self.config.masks else {}
        )
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
        calibration = parse_json(
            folder / info.intrinsic / str(kinect) / "calibration.json", Calibration
        )
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
        cameras = [camera] * len(frames)
        store = LazyFrames(
            folder,
            images,
            cameras,
            masks={n: MaskFiles(paths) for n, paths in masks.items()}
            if self.config.masks
            else None,
            depth=DepthFiles(depths, scale=0.001) if any(depths) else None,
            lenses=[lens] * len(frames),
            cache_mb=self.config.cache_mb,
        )
        return _View(store, cameras)

    def _others(self, folder: Path, info: SequenceInfo, frames: Sequence[Path]) -> dict[int, _View]:
        """Views of those other Kinects whose files are complete."""
        kinects = [k for k in range(4) if k != self.config.kinect]
        whole = {
            k: all(n.found(folder) for n in self._view_needs(info, frames, k)) for k in kinects
        }
        return {k: self._view(folder, info, frames, k) for k in kinects if whole[k]}

    def _tracks(
        self, folder: Path, info: SequenceInfo, fits: Fits
    ) -> tuple[dict[str, BodyTrack], dict[str, ObjectTrack]]:
        pose = pose_from_smplh(
            fits.poses, fits.places, same_betas(list(fits.betas), f"{folder}: SMPL+H fits"), "flat"
        )
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


class _Chain(FrameStore):
    """Several stores one after the other."""

    def __init__(self, stores: Sequence[FrameStore], length: int) -> None:
        self.stores, self.length, self.root = stores, length, stores[0].root

    def image(self, position: int) -> Any:
        return self.stores[position // self.length].image(position % self.length)

    def mask(self, entity: str, position: int) -> Any:
        return self.stores[position // self.length].mask(entity, position % self.length)

    def depth(self, position: int) -> Any:
        return self.stores[position // self.length].depth(position % self.length)

    def ignored(self, position: int) -> Any:
        return self.stores[position // self.length].ignored(position % self.length)


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
