"""reader:clip: the project's own clip folder, docs/reference/clip.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from hoigs.core.clip_folder.check import summarized_for_training, usable_clip
from hoigs.core.clip_folder.format import (
    HEADER,
    VIEWS,
    ClipHeader,
    ViewsHeader,
    body_key,
    depth_path,
    ignored_path,
    image_path,
    mask_path,
    parse_header,
)
from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.frame_times import FrameTimes, time_of
from hoigs.core.system.files import regular_file
from hoigs.core.system.npz import load_arrays
from hoigs.core.system.video_files import PixelCache
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import EntityKind
from hoigs.core.values.world import World
from hoigs.plugins.readers.checked_files import ReaderConfig

LEAST_BRIGHT = 16  # of a mask's brightest pixel, unless it is empty


class ClipFolderReader(ClipReader):
    """Reads a checked clip folder; pixels are decoded on access.

    Args:
        cache_mb: decoded pixels kept in memory, MiB, for the frames and again for held-out views.
    """

    Config: ClassVar = ReaderConfig
    config: ReaderConfig

    def matches(self, folder: Path) -> bool:
        return (Path(folder) / HEADER).is_file()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        header, problems = usable_clip(folder, self.allow_faults)
        unusable = frozenset(p.path for p in problems if p.unusable)
        size = (header.height, header.width)
        times = None if header.times is None else tuple(t / header.times[-1] for t in header.times)
        bodies, objects = {}, {}
        for name, entity in header.entities.items():
            if entity.kind == "human":
                bodies[name] = _read_body(folder / "bodies" / f"{name}.npz", header.version)
            else:
                objects[name] = _read_object(folder / "objects" / f"{name}.npz", times)
        moments = [
            _moment(i, time_of(i, header.frames, times), bodies) for i in range(header.frames)
        ]
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
            "world": _world(header),
        }
        held_out = self._read_held_out(folder, header, moments, shared, unusable)
        return Clip(
            name=header.name,
            store=FolderStore(
                folder, header.depth_kind != "none", self.config.cache_mb, unusable, size
            ),
            cameras=_read_cameras(folder / "cameras.npz", header.width, header.height),
            moments=moments,
            split=_kept({"train": header.split.train, "test": header.split.test}, unusable, folder),
            held_out=held_out,
            faults=summarized_for_training(problems, header),
            **shared,
        )

    def _read_held_out(
        self,
        folder: Path,
        header: ClipHeader,
        moments: list[Moment],
        shared: dict[str, Any],
        unusable: frozenset[str],
    ) -> Clip | None:
        if not (folder / VIEWS).is_file():
            return None
        views, _ = parse_header(folder / VIEWS, ViewsHeader)
        assert views is not None  # usable_clip has read it
        root = folder / "held_out"
        unusable = frozenset(
            p.removeprefix("held_out/") for p in unusable if p.startswith("held_out/")
        )
        views_left = _kept({"train": [], "test": list(range(len(views.frames)))}, unusable, root)
        return Clip(
            name=f"{header.name} held out",
            store=FolderStore(
                root,
                header.depth_kind != "none",
                self.config.cache_mb,
                unusable,
                (views.height, views.width),
            ),
            cameras=_read_cameras(root / "cameras.npz", views.width, views.height),
            moments=[moments[i] for i in views.frames],
            split=views_left,
            **shared,
        )


class FolderStore(FrameStore):
    """Pixels of a clip folder or of its held_out folder; the last used are kept in memory.

    Args:
        root: the clip folder, or its held_out folder. has_depth: whether depth maps are there.
        cache_mb: decoded pixels kept, MiB; the least recently used go first.
        unusable: absent and unreadable files, by their paths in `root`. Such an image is black and
            wholly ignored, such a mask empty and not known, such a depth map None.
        size: height and width, pixels; needed if any file is unusable.

    Safe to read from several threads.
    """

    root: Path

    def __init__(
        self,
        root: Path,
        has_depth: bool,
        cache_mb: int = 512,
        unusable: frozenset[str] = frozenset(),
        size: tuple[int, int] = (0, 0),
    ) -> None:
        self.root, self.has_depth = Path(root), has_depth
        self.unusable, self.size = unusable, size
        self.cache = PixelCache(cache_mb)

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        path = image_path(self.root, position)
        if self._is_unusable(path):
            return torch.zeros(*self.size, 3, dtype=torch.uint8)
        return self.cache.get(path, lambda: _decode(path, "RGB"))

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        if not self.mask_known(entity, position):
            return torch.zeros(self.size, dtype=torch.bool)
        path = mask_path(self.root, entity, position)
        return self.cache.get(path, lambda: _decode_mask(path))

    def mask_known(self, entity: str, position: int) -> bool:
        return not self._is_unusable(mask_path(self.root, entity, position))

    def _is_unusable(self, path: Path) -> bool:
        return bool(self.unusable) and path.relative_to(self.root).as_posix() in self.unusable

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        if self._is_unusable(image_path(self.root, position)):
            return torch.ones(self.size, dtype=torch.bool)
        path = ignored_path(self.root, position)
        if not path.is_file():
            return None
        return self.cache.get(path, lambda: _decode(path, "L") > 127)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        path = depth_path(self.root, position)
        if not self.has_depth or self._is_unusable(path):
            return None
        return self.cache.get(path, lambda: _read_depth(path))


def _decode(path: Path, mode: str) -> Tensor:
    try:
        with Image.open(regular_file(path)) as image:
            return torch.from_numpy(np.array(image.convert(mode)))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ClipError(f"{path} cannot be decoded ({error}); write it again") from error


def _decode_mask(path: Path) -> Bool[Tensor, "H W"]:
    grey = _decode(path, "L")
    if 0 < (brightest := int(grey.max())) < LEAST_BRIGHT:  # labels; nothing would count as seen
        raise ClipError(
            f"{path}: its brightest pixel is {brightest}, but a mask has 255 where the entity is "
            "seen and 0 elsewhere; write it again (docs/reference/clip.md)"
        )
    return grey > 127


def _read_depth(path: Path) -> Tensor:
    try:
        depth = load_arrays(path)["depth"].astype(np.float32)
    except (OSError, ValueError, KeyError) as error:
        raise ClipError(f"{path} cannot be read ({error}); write it again") from error
    return torch.from_numpy(np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0)))


def _kept(
    split: dict[str, list[int]], unusable: frozenset[str], folder: Path
) -> dict[str, list[int]]:
    """A split without the frames whose images are unusable."""
    left_out = {int(Path(p).stem) for p in unusable if p.startswith("images/")}
    left = {name: [i for i in frames if i not in left_out] for name, frames in split.items()}
    for name, frames in split.items():
        if frames and not left[name]:
            raise ClipError(
                f"{folder}: no image of split {name} is left: {sorted(left_out)} are unusable"
            )
    return left


def _tensors(path: Path) -> dict[str, Tensor]:
    """The arrays that are numbers: float64 and float16 become float32."""
    arrays = {k: torch.from_numpy(v) for k, v in load_arrays(path).items() if v.dtype.kind in "fb"}
    return {k: v.float() if v.is_floating_point() else v for k, v in arrays.items()}


def _kinds(header: ClipHeader) -> dict[str, EntityKind]:
    return {name: entity.kind for name, entity in header.entities.items()}


def _world(header: ClipHeader) -> World | None:
    """None in folders of before there was such a key; built-in clips have had one floor ever."""
    if header.world is not None:
        return World.from_dict(header.world.model_dump())
    if str(header.provenance.get("generator", "")).startswith("hoigs.synthesis "):
        return World(up=(0.0, 1.0, 0.0), floor=0.0)
    return None


def _read_cameras(path: Path, width: int, height: int) -> list[Camera]:
    arrays = _tensors(path)
    pairs = zip(arrays["K"], arrays["world_to_camera"], strict=True)
    return [Camera(K, w2c, width, height) for K, w2c in pairs]


def _read_body(path: Path, version: int) -> BodyTrack:
    tensors, words = _tensors(path), load_arrays(path)
    fields = ("global_orient", "body", "left_hand", "right_hand", "transl", "betas")
    convention: Any = str(words["hand_pose_convention"])
    poses = BodyPose(**{f: tensors[f] for f in fields}, hand_pose_convention=convention)
    return BodyTrack(
        body_key(str(words["model"]), version),
        poses,
        str(words.get("provenance", "unknown")),
        gender=str(words["gender"]) if "gender" in words else None,
        template=tensors.get("template"),
    )


def _read_object(path: Path, times: FrameTimes) -> ObjectTrack:
    provenance = str(load_arrays(path).get("provenance", "unknown"))
    fields = ("points", "colors", "rotations", "translations", "observed")
    tensors = _tensors(path)
    return ObjectTrack(
        **{f: tensors[f] for f in fields}, provenance=provenance, moving=tensors.get("moving"),
        times=times, rotation_known=bool(tensors.get("rotation_known", True)),
    )  # fmt: skip


def _moment(index: int, time: float, bodies: Mapping[str, BodyTrack]) -> Moment:
    return Moment(time, index, {name: track.poses.frame(index) for name, track in bodies.items()})
