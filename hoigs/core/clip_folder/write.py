"""Writing clip folders frame by frame; a folder appears only when it is complete."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from hoigs.core.clip_folder.check import check_clip, summarize
from hoigs.core.clip_folder.format import (
    CLIP,
    HEADER,
    VIEWS,
    ClipHeader,
    DepthKind,
    EntityHeader,
    SplitHeader,
    ViewsHeader,
    WorldHeader,
    depth_path,
    ignored_path,
    is_clip_folder,
    mask_path,
    stem,
)
from hoigs.core.errors import ClipError
from hoigs.core.system.files import failures_named
from hoigs.core.system.safe_replace import refuse_unwritable, require_replaceable
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, ObjectTrack, uniform_test_split
from hoigs.core.values.moment import POSE
from hoigs.core.values.world import World

# PixelFiles writes what a clip folder has of each frame: image, masks, depth, and the cameras.

Image8 = UInt8[Tensor, "H W 3"] | UInt8[np.ndarray, "H W 3"]
Mask = Bool[Tensor, "H W"] | Bool[np.ndarray, "H W"]
Depth = Float[Tensor, "H W"] | Float[np.ndarray, "H W"]
ImageFormat = Literal["png", "jpg"]


def as_array(values: Any, dtype: type = np.float32) -> np.ndarray:
    """Values of a tensor on any device, or of an array, for a file."""
    if isinstance(values, Tensor):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=dtype)


def _save_mask(path: Path, mask: Mask) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(as_array(mask, np.bool_).astype(np.uint8) * 255).save(path, compress_level=3)


class PixelFiles:
    """The frames of the clip itself, or of its held_out folder.

    Attributes:
        cameras: of the frames written so far. size: width and height of all, pixels.
    """

    def __init__(self, root: Path, image_format: ImageFormat, quality: int) -> None:
        self.root, self.image_format, self.quality = root, image_format, quality
        self.cameras: list[Camera] = []
        self.size: tuple[int, int] | None = None

    def add(
        self,
        image: Image8,
        camera: Camera,
        masks: Mapping[str, Mask],
        depth: Depth | None,
        depth_dtype: type,
        ignored: Mask | None = None,
    ) -> int:
        frame = len(self.cameras)
        pixels = as_array(image, np.uint8)
        height, width = pixels.shape[:2]
        self.size = self.size or (width, height)
        if (width, height) != self.size or (camera.width, camera.height) != self.size:
            raise ClipError(
                f"frame {frame}: image is {width}x{height} and its camera "
                f"{camera.width}x{camera.height}, but the clip is {self.size[0]}x{self.size[1]}"
            )
        self._save_image(pixels, frame)
        for name, mask in masks.items():
            _save_mask(mask_path(self.root, name, frame), mask)
        if ignored is not None and as_array(ignored, np.bool_).any():
            _save_mask(ignored_path(self.root, frame), ignored)
        if depth is not None:
            path = depth_path(self.root, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(path, depth=as_array(depth, depth_dtype))
        self.cameras.append(camera)
        return frame

    def _save_image(self, pixels: np.ndarray, frame: int) -> None:
        folder = self.root / "images"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{stem(frame)}.{self.image_format}"
        if self.image_format == "jpg":
            # 4:4:4: chroma subsampling would smear the borders that masks cut along
            Image.fromarray(pixels).save(path, quality=self.quality, subsampling=0)
        else:
            Image.fromarray(pixels).save(path, compress_level=3)

    def save_cameras(self) -> None:
        np.savez_compressed(
            self.root / "cameras.npz",
            K=np.stack([as_array(c.K) for c in self.cameras]),
            world_to_camera=np.stack([as_array(c.world_to_camera) for c in self.cameras]),
        )


# The npz files of a clip folder's bodies and objects.


def save_body(path: Path, track: BodyTrack) -> None:
    """Write a body's poses and shape.

    Raises:
        ClipError: the shape is not the same for all frames.
    """
    path.parent.mkdir(exist_ok=True)
    poses = track.poses
    if poses.betas.dim() != 1:
        raise ClipError(f"betas have shape {list(poses.betas.shape)}; a clip shares one [B]")
    # numpy declares these keywords as its own options
    parts: dict[str, Any] = {}
    if track.gender is not None:
        parts["gender"] = np.array(track.gender)
    if track.template is not None:
        parts["template"] = as_array(track.template)
    parts |= {f: as_array(getattr(poses, f)) for f in (*POSE, "betas")}
    np.savez_compressed(
        path,
        **parts,
        hand_pose_convention=np.array(poses.hand_pose_convention),
        model=np.array(track.model),
        provenance=np.array(track.provenance),
    )


def save_object(path: Path, track: ObjectTrack) -> None:
    """Write an object's points and poses."""
    path.parent.mkdir(exist_ok=True)
    # numpy declares these keywords as its own options
    parts: dict[str, Any] = {}
    if track.moving is not None:
        parts["moving"] = as_array(track.moving, np.bool_)
    if not track.rotation_known:
        parts["rotation_known"] = np.array(False)
    np.savez_compressed(
        path,
        **parts,
        points=as_array(track.points),
        colors=as_array(track.colors),
        rotations=as_array(track.rotations),
        translations=as_array(track.translations),
        observed=as_array(track.observed, np.bool_),
        provenance=np.array(track.provenance),
    )


class ClipWriter:
    """Writes a clip folder as its frames come; the folder appears only when it is complete.

    >>> with ClipWriter("clips/mine", name="mine", fps=30,
    ...                 entities={"human": "human", "box": "object"}) as writer:
    ...     writer.add_frame(image, camera, {"human": mask, "box": box_mask}, depth)  # each frame
    ...     writer.set_body("human", body_track)
    ...     writer.set_object("box", object_track)
    ...     writer.set_points(points, colors)

    Leaving the block writes the other files into the temporary folder beside the target, checks it
    with `require_clip`, and renames it; an exception leaves nothing behind.

    Args:
        folder: target. An older clip there is replaced, if nothing else is in its folder; any
            other non-empty folder is refused.
        name: for reports; the folder's name by default. fps: frames per second.
        entities: name to "human" or "object".
        depth_kind: "none" unless every frame and held-out view is given a depth.
        image_format: "png" (exact) or "jpg" (smaller; `quality`, no chroma subsampling).
        depth_dtype: np.float32, or np.float16 for half the size (2 mm steps at 4 m).

    Raises:
        ClipError: the folder exists and is not a clip, or the given values are inconsistent.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        fps: float | int,
        entities: Mapping[str, Literal["human", "object"]],
        name: str | None = None,
        depth_kind: DepthKind = "none",
        image_format: ImageFormat = "png",
        quality: int = 95,
        depth_dtype: type[np.floating[Any]] = np.float32,
    ) -> None:
        self.folder = Path(folder).absolute()
        self.name, self.fps, self.entities = name or self.folder.name, fps, dict(entities)
        self.depth_kind, self.depth_dtype = depth_kind, depth_dtype
        self.image_format, self.quality = image_format, quality
        self.provenance: dict[str, Any] = {}
        self._bodies: dict[str, BodyTrack] = {}
        self._objects: dict[str, ObjectTrack] = {}
        self._points: tuple[np.ndarray, np.ndarray] | None = None
        self._split: Mapping[str, Sequence[int]] | None = None
        self._colmap: Path | None = None
        self._times: list[float] | None = None
        self._world: World | None = None
        self._held_out_frames: list[int] = []
        refuse_to_overwrite(self.folder)

    def __enter__(self) -> ClipWriter:
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        self._root = Path(tempfile.mkdtemp(prefix=f".{self.folder.name}.", dir=self.folder.parent))
        self._root.chmod(0o755)
        self._main = PixelFiles(self._root, self.image_format, self.quality)
        self._held_out = PixelFiles(self._root / "held_out", self.image_format, self.quality)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            with failures_named(self.folder):
                if isinstance(error, OSError):
                    raise error
                if kind is None:
                    self._finish()
        finally:
            if self._root.exists():
                shutil.rmtree(self._root)

    @property
    def root(self) -> Path:
        """The temporary folder that becomes the clip: put your own files there, under other names.

        A clip with such files is never replaced by another.
        """
        return self._root

    @property
    def frames(self) -> int:
        """Frames added so far."""
        return len(self._main.cameras)

    def add_frame(
        self,
        image: Image8,
        camera: Camera,
        masks: Mapping[str, Mask],
        depth: Depth | None = None,
        ignored: Mask | None = None,
    ) -> int:
        """The next frame: RGB, its camera, visible pixels by entity, metres (0 = unknown).

        `ignored` marks pixels that show no scene. Returns the frame's number. Entities without a
        mask here are reported when the clip is finished.
        """
        return self._main.add(image, camera, masks, depth, self.depth_dtype, ignored)

    def add_held_out(
        self,
        frame: int,
        image: Image8,
        camera: Camera,
        masks: Mapping[str, Mask],
        depth: Depth | None = None,
        ignored: Mask | None = None,
    ) -> int:
        """A view never trained on, of the moment of main frame `frame`. Returns the view number."""
        self._held_out_frames.append(int(frame))
        return self._held_out.add(image, camera, masks, depth, self.depth_dtype, ignored)

    def set_body(self, entity: str, track: BodyTrack) -> None:
        """Poses [F, …] and betas [B] of a human."""
        self._bodies[entity] = track

    def set_object(self, entity: str, track: ObjectTrack) -> None:
        self._objects[entity] = track

    def set_points(
        self,
        points: Float[Tensor, "P 3"] | Float[np.ndarray, "P 3"],
        colors: Float[Tensor, "P 3"] | Float[np.ndarray, "P 3"],
    ) -> None:
        """Scene points in the world, metres, and RGB in [0, 1]."""
        self._points = (as_array(points), as_array(colors))

    def set_split(self, split: Mapping[str, Sequence[int]]) -> None:
        """ "train" and "test" frame numbers; `uniform_test_split` when never called."""
        self._split = split

    def set_times(self, seconds: Sequence[float]) -> None:
        """When each frame was taken, ascending, if they are not evenly spaced; `fps` is then their
        mean rate, whatever it was."""
        self._times = [float(s - seconds[0]) for s in seconds]

    def set_world(self, world: World) -> None:
        """Up, floor and unit; without it readers take them from the bodies, or the cameras."""
        self._world = world

    def set_colmap(self, model: Path) -> None:
        """A COLMAP model folder to keep beside the clip, as colmap/."""
        self._colmap = Path(model)

    def _finish(self) -> None:
        if not self.frames:
            raise ClipError(f"{self.folder}: no frame was added; a clip has at least one")
        self._main.save_cameras()
        for name, body in self._bodies.items():
            save_body(self._root / "bodies" / f"{name}.npz", body)
        for name, track in self._objects.items():
            save_object(self._root / "objects" / f"{name}.npz", track)
        if self._points:
            points, colors = self._points
            np.savez_compressed(self._root / "points.npz", points=points, colors=colors)
        if self._held_out_frames:
            self._save_held_out()
        if self._colmap:
            shutil.copytree(self._colmap, self._root / "colmap")
        header = self._header().model_dump(exclude_none=True)
        (self._root / HEADER).write_text(json.dumps(header, indent=2), encoding="utf-8")
        problems = check_clip(self._root)
        if problems:
            lines = "\n".join(f"  {line}" for line in summarize(problems))
            raise ClipError(f"{self.folder} was not written, the clip is incomplete:\n{lines}")
        replace_folder(self._root, self.folder)

    def _header(self) -> ClipHeader:
        assert self._main.size is not None
        split = self._split or uniform_test_split(self.frames)
        unknown = sorted((set(self._bodies) | set(self._objects)) - set(self.entities))
        if unknown:
            raise ClipError(f"tracks for {unknown}, which are not among {sorted(self.entities)}")
        entities = {}
        for name, kind in self.entities.items():
            if kind == "human" and name not in self._bodies:
                raise ClipError(f'no body track for "{name}": call set_body before leaving')
            body = self._bodies[name].model if kind == "human" else None
            entities[name] = EntityHeader(kind=kind, body=body)
        times = self._times
        if times is not None and not (len(times) == self.frames and times[-1] > 0):
            raise ClipError(
                f"{len(times)} times for {self.frames} frames; expected one for each, ascending"
            )
        return ClipHeader(
            name=self.name,
            fps=self.fps if times is None else (len(times) - 1) / times[-1],
            times=times,
            width=self._main.size[0],
            height=self._main.size[1],
            frames=self.frames,
            entities=entities,
            split=SplitHeader(**{k: [int(i) for i in split[k]] for k in ("train", "test")}),
            depth_kind=self.depth_kind,
            world=None if self._world is None else WorldHeader(**self._world.to_dict()),
            provenance=self.provenance,
        )

    def _save_held_out(self) -> None:
        self._held_out.save_cameras()
        assert self._held_out.size is not None
        width, height = self._held_out.size
        views = ViewsHeader(width=width, height=height, frames=self._held_out_frames)
        (self._root / VIEWS).write_text(views.model_dump_json(indent=2), encoding="utf-8")


def write_clip(clip: Clip, folder: str | Path, **options: Any) -> None:
    """Any Clip, wherever it was read from, as a clip folder; options go to ClipWriter."""
    # the scene is implied by the format
    entities = {n: k for n, k in clip.kinds.items() if k != "scene"}
    options = {"name": clip.name, "depth_kind": clip.depth_kind, **options}
    with ClipWriter(folder, fps=clip.fps, entities=entities, **options) as writer:
        for frame in clip:
            masks = {n: frame.masks[n] for n in entities}
            writer.add_frame(frame.image, frame.camera, masks, frame.depth, frame.ignored)
        for view in clip.held_out or ():
            masks = {n: view.masks[n] for n in entities}
            writer.add_held_out(
                view.moment.index, view.image, view.camera, masks, view.depth, view.ignored
            )
        for name, body in clip.bodies.items():
            writer.set_body(name, body)
        for name, track in clip.objects.items():
            writer.set_object(name, track)
        writer.set_points(clip.points, clip.point_colors)
        if clip.frame_times is not None:
            duration = (clip.num_frames - 1) / clip.fps
            writer.set_times([float(m.time) * duration for m in clip.moments])
        writer.set_split(clip.split)
        writer.set_world(clip.world)
        writer.provenance.update(clip.provenance)


def refuse_to_overwrite(folder: Path, inputs: Iterable[Path] = ()) -> None:
    """ClipError if `folder` holds anything but a clip; called before work starts, too.

    Args:
        inputs: what the new clip is made from; it must not be inside the old one.
    """
    refuse_unwritable(folder, error=ClipError)
    if folder.is_dir() and any(folder.iterdir()) and not is_clip_folder(folder):
        raise ClipError(
            f"{folder} is not empty and holds no {HEADER}: it is not overwritten; "
            "choose another name or empty it"
        )
    require_replaceable(folder, CLIP, inputs=inputs, error=ClipError)


def replace_folder(source: Path, target: Path) -> None:
    """Rename `source` to `target`; an older clip there is removed only after the rename."""
    refuse_to_overwrite(target)
    if not target.exists():
        source.rename(target)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent)) / "clip"
    target.rename(old)
    source.rename(target)
    shutil.rmtree(old.parent)
