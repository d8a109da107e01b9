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
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.clip_folder.diagnostics import summarize
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
    is_clip_folder,
)
from hoigs.core.clip_folder.frame_files import (
    Depth,
    FrameFiles,
    Image8,
    ImageFormat,
    Mask,
    as_array,
)
from hoigs.core.clip_folder.track_files import save_body, save_object
from hoigs.core.errors import ClipError
from hoigs.core.files.safe_replace import refuse_unwritable, require_replaceable
from hoigs.core.files.whole_files import failures_named
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, ObjectTrack, uniform_test_split
from hoigs.core.values.world import World


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
        self._main = FrameFiles(self._root, self.image_format, self.quality)
        self._held_out = FrameFiles(self._root / "held_out", self.image_format, self.quality)
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
