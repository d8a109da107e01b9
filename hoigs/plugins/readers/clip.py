"""reader:clip: the project's own clip folder, docs/reference/clip.md."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from pydantic import Field
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.clip_check import usable_clip
from hoigs.core.clip_format import (
    HEADER,
    VIEWS,
    ClipHeader,
    ViewsHeader,
    depth_path,
    ignored_path,
    image_path,
    load_arrays,
    mask_path,
    parse_header,
)
from hoigs.core.clip_problem import as_faults
from hoigs.core.config import ComponentConfig
from hoigs.core.errors import ClipError
from hoigs.core.interaction import EntityKind
from hoigs.core.moment import BodyPose, Moment
from hoigs.core.reader import ClipReader


class ClipFolderReaderConfig(ComponentConfig):
    """Settings of reader:clip."""

    cache_mb: int = Field(default=512, ge=0, description="decoded pixels kept in memory, MiB")


class ClipFolderReader(ClipReader):
    """Reads a checked clip folder; pixels are decoded when asked for.

    Args:
        cache_mb: decoded pixels kept in memory, MiB, for the frames and again for held-out views.
    """

    def __init__(self, cache_mb: int = 512) -> None:
        self.cache_mb = cache_mb

    def matches(self, folder: Path) -> bool:
        return (Path(folder) / HEADER).is_file()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        header, problems = usable_clip(folder, self.allow_faults)
        lost = frozenset(p.path for p in problems if p.lost)
        size = (header.height, header.width)
        bodies, objects = {}, {}
        for name, entity in header.entities.items():
            if entity.kind == "human":
                bodies[name] = _read_body(folder / "bodies" / f"{name}.npz")
            else:
                objects[name] = _read_object(folder / "objects" / f"{name}.npz")
        moments = [_moment(i, header.frames, bodies) for i in range(header.frames)]
        scene = _tensors(folder / "points.npz")
        shared: dict[str, Any] = {
            "kinds": _kinds(header),
            "bodies": bodies,
            "objects": objects,
            "points": scene["points"],
            "point_colors": scene["colors"],
            "fps": header.fps,
            "depth_kind": header.depth_kind,
            "provenance": header.provenance,
        }
        held_out = self._read_held_out(folder, header, moments, shared, lost)
        return Clip(
            name=header.name,
            store=FolderStore(folder, header.depth_kind != "none", self.cache_mb, lost, size),
            cameras=_read_cameras(folder / "cameras.npz", header.width, header.height),
            moments=moments,
            split=_kept({"train": header.split.train, "test": header.split.test}, lost, folder),
            held_out=held_out,
            faults=as_faults(problems, header),
            **shared,
        )

    def _read_held_out(
        self,
        folder: Path,
        header: ClipHeader,
        moments: list[Moment],
        shared: dict[str, Any],
        lost: frozenset[str],
    ) -> Clip | None:
        if not (folder / VIEWS).is_file():
            return None
        views, _ = parse_header(folder / VIEWS, ViewsHeader)
        assert views is not None  # usable_clip has read it
        room = folder / "held_out"
        lost = frozenset(p.removeprefix("held_out/") for p in lost if p.startswith("held_out/"))
        views_left = _kept({"train": [], "test": list(range(len(views.frames)))}, lost, room)
        return Clip(
            name=f"{header.name} held out",
            store=FolderStore(
                room,
                header.depth_kind != "none",
                self.cache_mb,
                lost,
                (views.height, views.width),
            ),
            cameras=_read_cameras(room / "cameras.npz", views.width, views.height),
            moments=[moments[i] for i in views.frames],
            split=views_left,
            **shared,
        )


class FolderStore(FrameStore):
    """Pixels of one room of a clip folder, the last used kept in memory.

    Args:
        root: the clip, or its held_out. has_depth: whether depth maps are there.
        cache_mb: decoded pixels kept, MiB; the least recently used go first.
        lost: files that are absent or hold nothing, by their paths in `root`. Such an image is
            black and all ignored, such a mask empty and not known, such a depth map None.
        size: height and width, pixels; needed where files are lost.

    Safe to read from several threads.
    """

    root: Path

    def __init__(
        self,
        root: Path,
        has_depth: bool,
        cache_mb: int = 512,
        lost: frozenset[str] = frozenset(),
        size: tuple[int, int] = (0, 0),
    ) -> None:
        self.root, self.has_depth = Path(root), has_depth
        self.lost, self.size = lost, size
        self.budget = cache_mb * 2**20
        self.cached_bytes = 0
        self._cache: OrderedDict[Path, Tensor] = OrderedDict()
        self._lock = threading.Lock()

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        path = image_path(self.root, position)
        if self._is_lost(path):
            return torch.zeros(*self.size, 3, dtype=torch.uint8)
        return self._get(path, lambda p: _decode(p, "RGB"))

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        if not self.mask_known(entity, position):
            return torch.zeros(self.size, dtype=torch.bool)
        return self._get(mask_path(self.root, entity, position), lambda p: _decode(p, "L") > 127)

    def mask_known(self, entity: str, position: int) -> bool:
        return not self._is_lost(mask_path(self.root, entity, position))

    def _is_lost(self, path: Path) -> bool:
        return bool(self.lost) and path.relative_to(self.root).as_posix() in self.lost

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        if self._is_lost(image_path(self.root, position)):
            return torch.ones(self.size, dtype=torch.bool)
        path = ignored_path(self.root, position)
        if not path.is_file():
            return None
        return self._get(path, lambda p: _decode(p, "L") > 127)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        if not self.has_depth or self._is_lost(depth_path(self.root, position)):
            return None
        return self._get(depth_path(self.root, position), _read_depth)

    def _get(self, path: Path, read: Callable[[Path], Tensor]) -> Tensor:
        with self._lock:
            if path in self._cache:
                self._cache.move_to_end(path)
                return self._cache[path]
        value = read(path)  # outside the lock: other threads decode meanwhile
        size = value.element_size() * value.numel()
        with self._lock:
            if path not in self._cache and size <= self.budget:
                self._cache[path] = value
                self.cached_bytes += size
            while self.cached_bytes > self.budget:
                _, old = self._cache.popitem(last=False)
                self.cached_bytes -= old.element_size() * old.numel()
        return value


def _decode(path: Path, mode: str) -> Tensor:
    try:
        with Image.open(path) as image:
            return torch.from_numpy(np.array(image.convert(mode)))
    except OSError as error:
        raise ClipError(f"{path} cannot be decoded ({error}); write it again") from error


def _read_depth(path: Path) -> Tensor:
    try:
        depth = load_arrays(path)["depth"].astype(np.float32)
    except (OSError, ValueError, KeyError) as error:
        raise ClipError(f"{path} cannot be read ({error}); write it again") from error
    return torch.from_numpy(np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0)))


def _kept(split: dict[str, list[int]], lost: frozenset[str], folder: Path) -> dict[str, list[int]]:
    """A split without the frames whose images are lost."""
    gone = {int(Path(p).stem) for p in lost if p.startswith("images/")}
    left = {name: [i for i in frames if i not in gone] for name, frames in split.items()}
    for name, frames in split.items():
        if frames and not left[name]:
            raise ClipError(f"{folder}: no image of split {name} is left: {sorted(gone)} are lost")
    return left


def _tensors(path: Path) -> dict[str, Tensor]:
    """The arrays that are numbers: float64 and float16 become float32."""
    arrays = {k: torch.from_numpy(v) for k, v in load_arrays(path).items() if v.dtype.kind in "fb"}
    return {k: v.float() if v.is_floating_point() else v for k, v in arrays.items()}


def _kinds(header: ClipHeader) -> dict[str, EntityKind]:
    return {name: entity.kind for name, entity in header.entities.items()}


def _read_cameras(path: Path, width: int, height: int) -> list[Camera]:
    arrays = _tensors(path)
    pairs = zip(arrays["K"], arrays["world_to_camera"], strict=True)
    return [Camera(K, w2c, width, height) for K, w2c in pairs]


def _read_body(path: Path) -> BodyTrack:
    tensors, words = _tensors(path), load_arrays(path)
    fields = ("global_orient", "body", "left_hand", "right_hand", "transl", "betas")
    convention: Any = str(words["hand_pose_convention"])
    poses = BodyPose(**{f: tensors[f] for f in fields}, hand_pose_convention=convention)
    return BodyTrack(
        str(words["model"]),
        poses,
        str(words.get("provenance", "unknown")),
        gender=str(words["gender"]) if "gender" in words else None,
        template=tensors.get("template"),
    )


def _read_object(path: Path) -> ObjectTrack:
    provenance = str(load_arrays(path).get("provenance", "unknown"))
    fields = ("points", "colors", "rotations", "translations", "observed")
    tensors = _tensors(path)
    return ObjectTrack(
        **{f: tensors[f] for f in fields}, provenance=provenance, moving=tensors.get("moving")
    )


def _moment(index: int, count: int, bodies: Mapping[str, BodyTrack]) -> Moment:
    time = index / (count - 1) if count > 1 else 0.0
    return Moment(time, index, {name: track.poses.frame(index) for name, track in bodies.items()})
