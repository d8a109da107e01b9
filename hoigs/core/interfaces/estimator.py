"""Estimator: what neural networks, or the files they wrote, find in a video before it is a clip.

A clip is made from a video and from estimates: masks, a person's landmarks, depth. They come from a
plugin, which runs a network, runs a tool in an environment of its own, or reads a folder of files.
Estimates are counted in frames of the video from 0, at its own size and with its lens distortion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float, UInt8

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.environments import ManagedEnvironment

Frames = Sequence[Any]  # one array a frame: a list, or LazyFrames
EstimateKind = Literal["masks", "landmarks", "depth"]
DepthKind = Literal["metric", "disparity"]
ESTIMATES: tuple[EstimateKind, ...] = ("masks", "landmarks", "depth")


@dataclass(frozen=True)
class PromptPoint:
    """A pixel that belongs to an entity, or does not (`inside=False`)."""

    x: float
    y: float
    inside: bool = True


@dataclass(frozen=True)
class FramePrompt:
    """Where an entity is in one frame.

    Attributes:
        frame: frame number in the video. points: on the entity, or off it (`inside=False`).
        box: x0, y0, x1, y1, pixels of the video.
    """

    frame: int
    points: tuple[PromptPoint, ...] = ()
    box: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class EntityRequest:
    """One object or person to look for.

    Attributes:
        name: the entity's name. kind: its kind.
        text: what to look for, for estimators that read ("a man", "football"); None: the name.
        points, box: where it is in frame `frame`, pixels of the video; box is x0, y0, x1, y1.
        frame: frame number in the video to which `points` and `box` belong.
        further: where it is in other frames.
    """

    name: str
    kind: Literal["human", "object"] = "object"
    text: str | None = None
    points: tuple[PromptPoint, ...] = ()
    box: tuple[float, float, float, float] | None = None
    frame: int = 0
    further: tuple[FramePrompt, ...] = ()

    @property
    def prompts(self) -> tuple[FramePrompt, ...]:
        """Everything that says where it is, one a frame, by frame."""
        first = FramePrompt(self.frame, self.points, self.box)
        given = (first,) if self.points or self.box is not None else ()
        return tuple(sorted((*given, *self.further), key=lambda prompt: prompt.frame))


@dataclass(frozen=True)
class VideoRequest:
    """A video, and what is to be estimated in it.

    Attributes:
        frames: number of frames of the video. width, height: pixels of each.
        read: frame number to RGB; use `frame`, which checks it. Going forwards is the cheap way.
        folder: the user's source folder; relative paths in an estimator's settings are meant from
            here.
        work: a folder for files in between, kept between runs; it need not exist yet.
        static_camera: the camera does not move.
        entities: to look for.
        wanted: frames that will be used; an estimator may skip the others. None: all.
        video: the file, for tools that read videos themselves; None when there are only frames.
        fps: frames a second.
        known: what other estimators have found in this video before: the person's masks and
            landmarks, for one that looks for objects. None: nothing yet.
    """

    frames: int
    width: int
    height: int
    read: Callable[[int], UInt8[np.ndarray, "H W 3"]]
    folder: Path
    work: Path
    static_camera: bool = False
    entities: tuple[EntityRequest, ...] = ()
    wanted: tuple[int, ...] | None = None
    video: Path | None = None
    fps: float = 30.0
    known: Estimates | None = None

    def frame(self, i: int) -> UInt8[np.ndarray, "H W 3"]:
        """Frame `i` of the video, RGB.

        Raises:
            IndexError: the video has no frame `i`.
            ValueError: `read` gave something else than an image of the video's size.
        """
        if not 0 <= i < self.frames:
            raise IndexError(f"frame {i} of a video of {self.frames} frames")
        image = self.read(i)
        if image.shape != (self.height, self.width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"frame {i} is {image.dtype} {image.shape}, expected uint8 "
                f"({self.height}, {self.width}, 3)"
            )
        return image

    @property
    def numbers(self) -> tuple[int, ...]:
        """The frames that are wanted, in order."""
        return tuple(range(self.frames)) if self.wanted is None else self.wanted

    def sequence(self) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
        """Number and image of each wanted frame, in order, one at a time."""
        return ((i, self.frame(i)) for i in self.numbers)

    def named(self, kind: Literal["human", "object"]) -> tuple[str, ...]:
        """Names of the entities of one kind."""
        return tuple(entity.name for entity in self.entities if entity.kind == kind)

    def resolve(self, path: Path) -> Path:
        """A path of an estimator's settings: relative ones start at `folder`; ~ is the user's
        home."""
        return self.folder / path.expanduser()

    def write_frames(self) -> Path:
        """Every wanted frame as `work`/frames/00017.png, for tools that read files.

        Files that are there already are kept: `work` belongs to one video.
        """
        from PIL import Image

        folder = self.work / "frames"
        folder.mkdir(parents=True, exist_ok=True)
        for i in self.numbers:
            path = folder / f"{i:05d}.png"
            if not path.is_file():
                half = path.with_suffix(".part")
                Image.fromarray(self.frame(i)).save(half, format="PNG", compress_level=1)
                half.replace(path)
        return folder


class LazyFrames(Sequence[Any]):
    """One array a frame, made on access, so that those of a long video fit in memory.

    Args:
        count: number of frames.
        read: frame number to array.
    """

    def __init__(self, count: int, read: Callable[[int], np.ndarray]) -> None:
        self._count, self._read = count, read

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: Any) -> Any:
        """Array `i`; of a slice, another LazyFrames."""
        if isinstance(i, slice):
            chosen = range(self._count)[i]
            return LazyFrames(len(chosen), lambda k: self._read(chosen[k]))
        return self._read(range(self._count)[i])


@dataclass(frozen=True)
class EntityMasks:
    """Where entities are: bool [H, W] for each frame of the video.

    Attributes:
        entities: name to its masks, a list or LazyFrames. All False: not seen in that frame.
        together: masks of all entities at once, where they are not separated; None if they are.
        provenance: who made them, with what, in a line.
        confidence: mask confidence of each entity in each frame, 0..1; NaN: not computed.
        chosen: prompts found for each entity that was requested without one.
        notes: sentences for the report, on what is doubtful.
        states: of each entity, where it is in each frame of the video: "seen" where its mask is
            verified, else "doubtful" (there is one), "out of the picture", "hidden by …" or "lost";
            absent: not computed.
    """

    entities: Mapping[str, Frames] = field(default_factory=dict)
    together: Frames | None = None
    provenance: str = ""
    confidence: Mapping[str, Float[np.ndarray, " F"]] = field(default_factory=dict)
    chosen: Mapping[str, tuple[FramePrompt, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    states: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Landmarks:
    """MediaPipe's 33 landmarks of one person over the video; NaN where not found or not known.

    Attributes:
        image_xyzv: x, y in pixels, (0, 0) the outer corner of the first; z, a depth relative to the
            hips in the scale of x; visibility in [0, 1].
        world_xyzv: x, y, z in metres about the hips' middle along the camera's axes (x right,
            y down, z away), and visibility; None when the estimator sees the image only.
        to_hips: those axes are of a camera that is turned to look at the hips' middle, as
            MediaPipe's network sees the person, and not of the video's own.
        world_spread: by how much a component of `world_xyzv` is off, standard deviation, metres; by
            default as MediaPipe's was measured to be.
        provenance: who made them, with what, in a line.
        lost: why a frame has none, in words that end a sentence, to the frames of which it is true;
            those without landmarks that are in none are reported without a reason.
        repaired: how they were found, for frames in which the first attempt failed.
    """

    image_xyzv: Float[np.ndarray, "F 33 4"]
    world_xyzv: Float[np.ndarray, "F 33 4"] | None = None
    provenance: str = ""
    lost: Mapping[str, Sequence[int]] = field(default_factory=dict)
    repaired: Mapping[str, Sequence[int]] = field(default_factory=dict)
    to_hips: bool = False
    world_spread: float = 0.1


@dataclass(frozen=True)
class DepthMaps:
    """Depth of each frame of the video: float32 [H, W], NaN where it is not known.

    Attributes:
        maps: a list or LazyFrames.
        kind: "metric": metres along the optical axis, positive. "disparity": grows towards
            the camera: 1/depth up to a scale and a shift of each frame's own.
        provenance: who made them, with what, in a line.
    """

    maps: Frames
    kind: DepthKind
    provenance: str = ""


@dataclass(frozen=True)
class Estimates:
    """What one estimator finds in a video; None or empty for what it does not provide.

    Attributes:
        landmarks: name of a human entity to its landmarks.
    """

    masks: EntityMasks | None = None
    landmarks: Mapping[str, Landmarks] = field(default_factory=dict)
    depth: DepthMaps | None = None


class PromptError(HoigsError):
    """Nothing, nobody, or somebody else is where a prompt says."""


class Estimator(Configurable, ABC):
    """An estimator, or a reader of an estimator's files: a video in, estimates out.

    Attributes:
        provides: which of "masks", "landmarks" and "depth" it gives, of every request.
        environment: of the programs that it runs, where hoigs makes it; None: it runs none, or in
            an environment of the user's.
    """

    provides: ClassVar[frozenset[EstimateKind]] = frozenset()
    environment: ClassVar[ManagedEnvironment | None] = None

    def __init__(self, config: Any = None) -> None:
        """`config`: a `Config`; by default one with its defaults."""
        self.config = config or self.Config()

    def __repr__(self) -> str:
        """Class and settings, the same in every process: results are kept under such a name."""
        settings = ", ".join(f"{k}={v!r}" for k, v in sorted(vars(self).items()))
        return f"{type(self).__name__}({settings})"

    def commands(self) -> tuple[str, ...]:
        """Command lines of the programs that its settings make it run, as people write them.

        Estimators whose settings name a program must list it here: options may come from an
        untrusted file, and `hoigs prepare` runs such programs only with --allow-commands.
        """
        return ()

    def people(self, video: VideoRequest) -> tuple[FramePrompt, ...]:
        """A box about everybody in one frame, from a quick look at a few of them, the first that
        of the one whom it would follow; empty where it does not look.

        Raises:
            HoigsError: as `estimate`.
        """
        return ()

    @abstractmethod
    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        """The estimates, lazily where it is large; callers pass it through `checked`.

        Long work leaves its results in `video.work`, so that it need not be done twice.

        Raises:
            PromptError: a prompt shows nothing that can be followed.
            HoigsError: naming every file that is absent or does not fit and who makes it, or the
                tool that failed and its last output.
        """


def checked(estimates: Estimates, video: VideoRequest, estimator: Estimator) -> Estimates:
    """`estimates`, if they are what `estimator` declares for `video`; arrays are checked when read.

    Raises:
        ValueError: something that `provides` names is absent, or has another frame count or shape.
    """
    given = {
        "masks": estimates.masks is not None,
        "landmarks": bool(estimates.landmarks),
        "depth": estimates.depth is not None,
    }
    who = type(estimator).__name__
    absent = [kind for kind in ESTIMATES if kind in estimator.provides and not given[kind]]
    if absent:
        raise ValueError(f"{who} gave no {' and no '.join(absent)}, which its `provides` declares")
    for name, track in estimates.landmarks.items():
        _require_frames(len(track.image_xyzv), video, f"{who}: landmarks of {name}")
    masks, depth = estimates.masks, estimates.depth
    if masks is not None:
        if not masks.entities and masks.together is None:
            raise ValueError(f"{who} gave no masks: neither of entities nor of all together")
        together = masks.together
        if together is not None:
            together = _checked(together, video, bool, f"{who}: mask of all together")
        entities = {
            n: _checked(m, video, bool, f"{who}: mask of {n}") for n, m in masks.entities.items()
        }
        masks = replace(masks, entities=entities, together=together)
    if depth is not None:
        maps = _checked(depth.maps, video, np.float32, f"{who}: depth")
        depth = DepthMaps(maps, depth.kind, depth.provenance)
    return Estimates(masks, estimates.landmarks, depth)


def _require_frames(count: int, video: VideoRequest, what: str) -> None:
    if count != video.frames:
        raise ValueError(f"{what}: {count} frames, the video has {video.frames}")


def _checked(frames: Frames, video: VideoRequest, dtype: type, what: str) -> LazyFrames:
    _require_frames(len(frames), video, what)

    def read(i: int) -> np.ndarray:
        array = frames[i]
        if array.shape != (video.height, video.width) or array.dtype != dtype:
            raise ValueError(
                f"{what}, frame {i}: {array.dtype} {array.shape}, expected {np.dtype(dtype)} "
                f"({video.height}, {video.width})"
            )
        return array

    return LazyFrames(len(frames), read)


# landmark of MediaPipe's 33 for each of COCO's 17 keypoints
COCO_17_LANDMARKS = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
# and for OpenPose's BODY_25; -1 (neck, middle of the hips, small toes) has no counterpart
BODY_25_LANDMARKS = (
    0, -1, 12, 14, 16, 11, 13, 15, -1, 24, 26, 28, 23, 25, 27, 5, 2, 8, 7, 31, -1, 29, 32, -1, 30,
)  # fmt: skip


def landmarks_from_keypoints(
    keypoints: Float[np.ndarray, "F K 3"],
    targets: Sequence[int] = COCO_17_LANDMARKS,
    provenance: str = "",
) -> Landmarks:
    """Keypoints of another convention among MediaPipe's 33; those without a counterpart are NaN.

    Args:
        keypoints: x, y in pixels and a score in [0, 1]; a score of 0 or NaN means not found.
        targets: the landmark of each keypoint, -1 for none: COCO_17_LANDMARKS, BODY_25_LANDMARKS.

    Raises:
        ValueError: another number of keypoints than `targets`.
    """
    if keypoints.shape[1] != len(targets):
        raise ValueError(f"{keypoints.shape[1]} keypoints, expected {len(targets)}")
    image = np.full((len(keypoints), 33, 4), np.nan, np.float32)
    for source, target in enumerate(targets):
        if target >= 0:
            found = keypoints[:, source, 2] > 0
            image[found, target, :2] = keypoints[found, source, :2]
            image[found, target, 3] = keypoints[found, source, 2]
    return Landmarks(image, None, provenance)
