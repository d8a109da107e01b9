"""reader:arctic: one camera of an ARCTIC sequence (Fan 2023): SMPL-X and objects of two parts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field

from hoigs.core.errors import ClipError, did_you_mean
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.smpl_params import pose_from_smplx
from hoigs.core.system.unpickling import load_pickled_npy
from hoigs.core.values.clip import BodyTrack, Clip, ObjectTrack, uniform_test_split
from hoigs.core.values.lens import Lens
from hoigs.core.values.tokens import EntityKind
from hoigs.plugins.readers.checked_files import (
    Need,
    ReaderConfig,
    entry,
    load_json,
    numbers,
    parse_json_map,
    require_files,
)
from hoigs.plugins.readers.lazy_frames import (
    LazyFrames,
    MaskFiles,
    PixelFiles,
    image_files,
    image_size,
    video_moments,
)
from hoigs.plugins.readers.points import checked_rotation, load_mesh, points_along_rays, rigid

LAYOUT = "an ARCTIC sequence (images/sXX/SEQUENCE or .../SEQUENCE/VIEW)"
DOWNLOAD = "`bash/download_*.sh` of zc-alexfan/arctic (a registered download)"
WITHHELD = f"{DOWNLOAD}; of s03, the test subject, ground truth is withheld"
MASKS = (
    "ARCTIC has no masks: your segmenter makes them, 0/255, named as the images (HOLD took SAM); "
    "or `--reader-set masks=false`"
)
SMPLX = ("global_orient", "body_pose", "left_hand_pose", "right_hand_pose", "transl")
EGO = ("R_k_cam_np", "T_k_cam_np", "dist8", "intrinsics")
HINGE = (0.0, 0.0, -1.0)  # the top turns about it (common/object_tensors.py)
FPS = 30.0
BEHIND = (1.0, 4.0)  # scene points start within these times the object's distance


class ArcticConfig(ReaderConfig):
    """Settings of reader:arctic."""

    view: int | None = Field(
        default=None, ge=0, le=8, description="0 is on the head, 1 to 8 stand still; 1 by default"
    )
    start: int = Field(default=0, ge=0, description="first frame of the ground truth")
    count: int | None = Field(default=None, ge=2, description="frames; by default all (HOLD: 300)")
    masks: bool = Field(default=True, description="False reads only the scene")
    points: int = Field(default=20_000, ge=1, description="scene points to start from")


class ArcticReader(ClipReader):
    """Frames, cameras, SMPL-X poses and an object's pose, in metres.

    Image numbers are frame numbers plus the subject's ioi_offset; the object's millimetres become
    metres; hands are flat_hand_mean=True; the body is the subject's own template on the model of
    its gender, which `body:smplx` then requires. The top of an object is placed at its median
    angle, which suits "grab" sequences, and is marked as the moving part.
    """

    Config: ClassVar = ArcticConfig
    config: ArcticConfig

    def matches(self, folder: Path) -> bool:
        return _place(Path(folder), self.config.view) is not None

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        place = _place(folder, self.config.view)
        if place is None:
            require_files(folder, LAYOUT, [])
            raise ClipError(f"{folder} is not named as {LAYOUT}")
        require_files(place.root, LAYOUT, place.needs())
        misc = parse_json_map(place.root / "meta/misc.json", Subject)
        if place.subject not in misc:
            near = did_you_mean(place.subject, misc)
            raise ClipError(f"{place.root}/meta/misc.json has no subject {place.subject}{near}")
        subject = misc[place.subject]
        truth = numbers(load_pickled_npy(place.raw("object")), str(place.raw("object")), -1, 7)
        frames = self._frames(place, subject, len(truth))
        images = [place.image(f + subject.ioi_offset) for f in frames]
        masks = {n: [place.mask(n, p) for p in images] for n in ("human", "object")}
        if self.config.masks:
            wanted = [p for paths in masks.values() for p in paths]
            needs = [Need.of(str(p.relative_to(place.root)), maker=MASKS) for p in wanted]
            require_files(place.root, LAYOUT, needs)
        lens, poses = _cameras(place, subject, frames)
        width, height = image_size(images[0])
        if (width, height) != (lens.width, lens.height):
            raise ClipError(
                f"{images[0]} is {width}x{height}, its calibration is for {lens.width}x"
                f"{lens.height}: the full images are needed, not cropped_images/"
            )
        cameras = [lens.camera(w2c) for w2c in poses]
        both: dict[str, EntityKind] = {"human": "human", "object": "object"}
        kinds = both if self.config.masks else {}
        bodies = {"human": _body(place, subject, frames)} if self.config.masks else {}
        track, angles = _object(place, truth[frames])
        known = {n: MaskFiles(paths) for n, paths in masks.items()} if self.config.masks else None
        pixels, lenses = PixelFiles(images, masks=known), [lens] * len(frames)
        cache = self.config.cache_mb
        store = LazyFrames(place.root, pixels, cameras, lenses=lenses, cache_mb=cache)
        away = float(cameras[0].to_camera(track.translations)[:, 2].median())
        span = (BEHIND[0] * away, BEHIND[1] * away)
        points, colors = points_along_rays(store, cameras, tuple(kinds), span, self.config.points)
        return Clip(
            name=f"{place.subject}_{place.sequence}_{place.view}",
            store=store,
            cameras=cameras,
            moments=video_moments(range(len(frames)), len(frames), bodies),
            kinds=kinds,
            bodies=bodies,
            objects={"object": track} if self.config.masks else {},
            points=points,
            point_colors=colors,
            split=uniform_test_split(len(frames)),
            fps=FPS,
            provenance={
                "reader": "reader:arctic",
                "cameras": f"view {place.view}, frames {frames[0]} to {frames[-1]}",
                "points": f"random, {span[0]:.2f} to {span[1]:.2f} m away",
                "articulation": {"unit": "rad", "least": angles.min(), "most": angles.max()},
            },
        )

    def _frames(self, place: _Place, subject: Subject, total: int) -> list[int]:
        """Frames of the ground truth to read: the requested ones that have images."""
        start, count = self.config.start, self.config.count
        stop = total if count is None else min(total, start + count)
        there = {int(p.stem) - subject.ioi_offset for p in image_files(place.images)
                 if p.stem.isdigit()}  # fmt: skip
        inside = [f for f in range(start, stop) if f in there]
        if not inside:
            raise ClipError(
                f"{place.images}: no image of frames {start} to {stop - 1}, which are images "
                f"{start + subject.ioi_offset:05d} to {stop - 1 + subject.ioi_offset:05d} "
                f"(ioi_offset {subject.ioi_offset}); {DOWNLOAD} has them"
            )
        folder = place.images.relative_to(place.root)
        gaps = range(inside[0], inside[-1] + 1)
        names = [f"{folder}/{f + subject.ioi_offset:05d}.jpg" for f in gaps]
        require_files(place.root, LAYOUT, [Need.of(n, maker=DOWNLOAD) for n in names])
        return list(gaps)


class Subject(BaseModel):
    """An entry of meta/misc.json; views 1 to 8 of the matrices, 0 to 8 of the sizes."""

    gender: str
    world2cam: list[list[list[float]]]
    intris_mat: list[list[list[float]]]
    image_size: list[tuple[int, int]]
    ioi_offset: int


@dataclass(frozen=True)
class _Place:
    """Paths of a sequence's files in the data folder."""

    root: Path
    subject: str
    sequence: str
    view: int

    @property
    def object_name(self) -> str:
        return self.sequence.split("_", maxsplit=1)[0]

    @property
    def images(self) -> Path:
        return self.root / "images" / self.subject / self.sequence / str(self.view)

    def image(self, number: int) -> Path:
        return self.images / f"{number:05d}.jpg"

    def mask(self, entity: str, image: Path) -> Path:
        folder = self.root / "masks" / self.subject / self.sequence / str(self.view)
        return folder / entity / f"{image.stem}.png"

    def raw(self, kind: str) -> Path:
        return self.root / "raw_seqs" / self.subject / f"{self.sequence}.{kind}.npy"

    def needs(self) -> list[Need]:
        kinds = ("smplx", "object", *(("egocam.dist",) if self.view == 0 else ()))
        own = [f"raw_seqs/{self.subject}/{self.sequence}.{kind}.npy" for kind in kinds]
        template = f"meta/object_vtemplates/{self.object_name}"
        meta = ("meta/misc.json", f"meta/subject_vtemplates/{self.subject}.obj",
                f"{template}/mesh.obj", f"{template}/parts.json")  # fmt: skip
        images = f"images/{self.subject}/{self.sequence}/{self.view}/"
        needs = [Need.of(path, maker=WITHHELD) for path in own]
        return [*needs, *(Need.of(path, maker=DOWNLOAD) for path in (*meta, images))]


def _place(folder: Path, view: int | None) -> _Place | None:
    """Parse the end of the path: images/sXX/SEQUENCE, or images/sXX/SEQUENCE/VIEW."""
    parts = folder.resolve().parts
    named = len(parts) > 4 and re.fullmatch(r"[0-8]", parts[-1]) is not None
    tail = parts[-4:-1] if named else parts[-3:]
    if len(tail) < 3 or tail[0] != "images" or not re.fullmatch(r"s\d\d", tail[1]):
        return None
    root = folder.resolve().parents[3 if named else 2]
    shown = int(parts[-1]) if named else 1
    return _Place(root, tail[1], tail[2], shown if view is None else view)


def _cameras(
    place: _Place, subject: Subject, frames: Sequence[int]
) -> tuple[Lens, list[Float[np.ndarray, "4 4"]]]:
    """The lens and world-to-camera. Views 1 to 8 stand still and have no distortion; view 0 moves
    with the head and is distorted."""
    where, size = f"{place.root}/meta/misc.json: {place.subject}", subject.image_size[place.view]
    if place.view > 0:
        pose = numbers(subject.world2cam[place.view - 1], f"{where} world2cam", 4, 4)
        pose = rigid(checked_rotation(pose[:3, :3], f"{where} world2cam"), pose[:3, 3])
        K = numbers(subject.intris_mat[place.view - 1], f"{where} intris_mat", 3, 3)
        return Lens.opencv(K, [], *size), [pose] * len(frames)
    ego: Any = load_pickled_npy(place.raw("egocam.dist"))
    where = str(place.raw("egocam.dist"))
    read = {key: numbers(entry(ego, key, where), f"{where}: {key}") for key in EGO}
    turns = numbers(read["R_k_cam_np"], f"{where}: R_k_cam_np", -1, 3, 3)
    shifts = read["T_k_cam_np"]  # [T, 3] or [T, 3, 1]
    if shifts.size != 3 * len(turns):
        raise ClipError(
            f"{where}: T_k_cam_np: expected three numbers for each of {len(turns)} frames, got the "
            f"shape {list(shifts.shape)}"
        )
    shifts = shifts.reshape(-1, 3)
    if len(turns) <= max(frames):
        raise ClipError(f"{where} ends before frame {max(frames)}")
    K = numbers(read["intrinsics"], f"{where}: intrinsics", 3, 3)
    lens = Lens.opencv(K, read["dist8"].reshape(-1).tolist(), *size)
    return lens, [rigid(checked_rotation(turns[f], f"{where}: {f}"), shifts[f]) for f in frames]


def _body(place: _Place, subject: Subject, frames: Sequence[int]) -> BodyTrack:
    table: Any = load_pickled_npy(place.raw("smplx"))
    where = str(place.raw("smplx"))
    values = {
        k: torch.from_numpy(numbers(entry(table, k, where), f"{where}: {k}", -1, -1)) for k in SMPLX
    }
    short = {k: len(v) for k, v in values.items() if len(v) <= max(frames)}
    if short:
        raise ClipError(f"{place.raw('smplx')} ends before frame {max(frames)}: {short}")
    chosen = {k: v[list(frames)] for k, v in values.items()}
    pose = pose_from_smplx({**chosen, "betas": torch.zeros(10).double()}, "flat")
    path = place.root / "meta/subject_vtemplates" / f"{place.subject}.obj"
    template = np.asarray(load_mesh(path).vertices, np.float64)
    return BodyTrack(
        "body:smplx",
        pose.to(torch.float32),
        f"{place.raw('smplx').name}; template of {place.subject}; jaw and eyes left out",
        gender=subject.gender,
        template=torch.from_numpy(template).float(),
    )


def _object(
    place: _Place, truth: Float[np.ndarray, "F 7"]
) -> tuple[ObjectTrack, Float[np.ndarray, " F"]]:
    """The track of the mesh's centre, and the angles of its top, radians."""
    folder = place.root / "meta/object_vtemplates" / place.object_name
    vertices = np.asarray(load_mesh(folder / "mesh.obj").vertices, np.float64) / 1000
    parts = numbers(load_json(folder / "parts.json"), f"{folder / 'parts.json'}", -1) > 0
    if len(parts) != len(vertices):
        raise ClipError(
            f"{folder}: parts.json has {len(parts)} entries, mesh.obj {len(vertices)} vertices"
        )
    angles = truth[:, 0]
    turn = axis_angle_to_matrices(torch.tensor(HINGE).double() * float(np.median(angles))).numpy()
    points = np.where(parts[:, None], vertices @ turn.T, vertices)
    center = points.mean(0)
    rotations = axis_angle_to_matrices(torch.from_numpy(truth[:, 1:4]))
    places = torch.from_numpy(truth[:, 4:] / 1000) + rotations @ torch.from_numpy(center)
    about = torch.from_numpy(points - center).float()
    track = ObjectTrack(
        points=about,
        colors=torch.full_like(about, 0.5),
        rotations=rotations.float(),
        translations=places.float(),
        observed=torch.ones(len(truth), dtype=torch.bool),
        provenance=f"{place.raw('object').name}; mesh.obj",
        moving=torch.from_numpy(parts),
    )
    return track, angles
