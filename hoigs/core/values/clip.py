"""Clip: the frames, cameras, masks, bodies and objects that a reconstruction starts from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.maths.frame_times import FrameTimes
from hoigs.core.reporting import Diagnostic
from hoigs.core.system.files import is_plain
from hoigs.core.system.video_files import PixelCache
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.shown import SHOWN, html_table, one_line
from hoigs.core.values.tokens import EntityKind
from hoigs.core.values.world import World

CACHE_MB = 512  # of resized images kept in memory
EVEN = 1e-5  # of the clip: times this near to even ones are even
# keys of Clip.provenance
CAMERAS_REFINED = "cameras_refined_in_training"
POSES_ESTIMATED = "poses_estimated"  # body poses were estimated from the frames, test ones too
POSES_EXACT = "poses_exact"  # body poses and shapes are the truth: nothing is left to refine


class FrameStore(ABC):
    """Pixels on demand; implementations decode lazily and may cache. Positions, not names.

    Attributes:
        root: the folder that the pixels come from, where they come from one.
    """

    root: Path | None = None

    @abstractmethod
    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        """RGB."""

    @abstractmethod
    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        """Visible pixels of an entity; all False where it is not seen."""

    @abstractmethod
    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        """Depth along z, metres; 0 where unknown (NaN and infinity are cleaned by the reader)."""

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        """Pixels that show no scene; None where all do."""
        return None

    def mask_known(self, entity: str, position: int) -> bool:
        """Whether there is a mask at all; where there is not, `mask` is empty."""
        del entity, position
        return True


@dataclass(frozen=True)
class Frame:
    """One view of a clip, decoded.

    Attributes:
        position: its place in the clip's frame list. moment.index is the frame number.
        masks: by entity, visible pixels. depth: metres, 0 = unknown, or None.
        ignored: pixels that show no scene (painted over, outside the lens image): they are
            left out of losses and scores. None without any.
        unknown: entities that have no mask here; theirs in `masks` is empty and means nothing.
    """

    position: int
    moment: Moment
    camera: Camera
    image: UInt8[Tensor, "H W 3"]
    masks: dict[str, Bool[Tensor, "H W"]]
    depth: Float[Tensor, "H W"] | None
    ignored: Bool[Tensor, "H W"] | None = None
    unknown: frozenset[str] = frozenset()

    __repr__ = one_line

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """RGB in [0, 1]."""
        return self.image.float() / 255.0

    def to(self, device: torch.device | str) -> Frame:
        """The same view with its moment, camera and pixels on a device."""
        depth, ignored = self.depth, self.ignored
        return replace(
            self,
            moment=self.moment.to(device),
            camera=self.camera.to(device),
            image=self.image.to(device),
            masks={name: mask.to(device) for name, mask in self.masks.items()},
            depth=None if depth is None else depth.to(device),
            ignored=None if ignored is None else ignored.to(device),
        )


@dataclass(frozen=True)
class BodyTrack:
    """A body over the clip: which body model, and a BodyPose batched over the frames.

    Attributes:
        model: registry key, for example "body:anny".
        gender: gender of the body model that the poses were fitted with ("male", "female",
            "neutral"), where that matters; body models refuse another.
        template: the person's own zero-pose vertices, metres, in place of the model's mean
            (ARCTIC); the betas come on top of it.
    """

    model: str
    poses: BodyPose
    provenance: str = "unknown"
    gender: str | None = None
    template: Float[Tensor, "V 3"] | None = None

    __repr__ = one_line

    def cut(self, rows: slice) -> BodyTrack:
        """The track over some frames."""
        return replace(self, poses=self.poses.frame(rows))


@dataclass(frozen=True)
class ObjectTrack:
    """What is known of an object before training.

    Attributes:
        points: canonical points about the object's centre, metres, at world scale.
        colors: RGB in [0, 1].
        rotations: object to world, per frame. translations: object centre in the world, metres.
        observed: frames in which the object was seen; the others are interpolated.
        provenance: who made the track, for reports.
        moving: mask of the points on the moving part of an object in two parts; None if
            that is not known, or there are no parts.
        times: frame times in [0, 1]; None if they are evenly spaced.
        rotation_known: whether `rotations` are measured; False if they are constant (a ball), or
            only the roll in the image.
    """

    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    rotations: Float[Tensor, "F 3 3"]
    translations: Float[Tensor, "F 3"]
    observed: Bool[Tensor, " F"]
    provenance: str = "unknown"
    moving: Bool[Tensor, " P"] | None = None
    times: FrameTimes = None
    rotation_known: bool = True

    __repr__ = one_line

    def cut(self, rows: slice) -> ObjectTrack:
        """The track over some frames, whose times run from 0 to 1 again."""
        return replace(
            self,
            rotations=self.rotations[rows],
            translations=self.translations[rows],
            observed=self.observed[rows],
            times=None if self.times is None else _stretched(self.times[rows]),
        )


@dataclass(frozen=True)
class Clip:
    """Everything that training and evaluation read; frames are lazy and uint8.

    Attributes:
        name: for reports.
        store: pixels. cameras, moments: one a frame, in order.
        points, point_colors: scene points (COLMAP, or back-projected depth), metres, RGB [0, 1].
        split: "train" and "test" positions.
        kinds: entity name to kind; "scene" is implicit.
        bodies: by human entity. objects: by object entity.
        held_out: the same moments from cameras never trained on, or None.
        fps: frames a second.
        depth_kind: "metric", "affine-disparity" or "none".
        provenance: where each part came from.
        faults: what is wrong with the clip and was accepted when it was read (`clip_folder.health`
            finds more).
        world: up, floor and unit. Without a source, up is guessed from the cameras, which
            `world.known` says.

    Raises:
        ClipError: the name of the clip, or of an entity, holds control characters.
    """

    name: str
    store: FrameStore
    cameras: Sequence[Camera]
    moments: Sequence[Moment]
    points: Float[Tensor, "P 3"]
    point_colors: Float[Tensor, "P 3"]
    split: Mapping[str, Sequence[int]]
    kinds: Mapping[str, EntityKind] = field(default_factory=dict)
    bodies: Mapping[str, BodyTrack] = field(default_factory=dict)
    objects: Mapping[str, ObjectTrack] = field(default_factory=dict)
    held_out: Clip | None = None
    fps: float = 30.0
    depth_kind: str = "none"
    provenance: Mapping[str, Any] = field(default_factory=dict)
    faults: Sequence[Diagnostic] = ()
    world: World = None  # type: ignore[assignment]  # filled in below

    def __post_init__(self) -> None:
        for what, name in (("clip", self.name), *(("entity", name) for name in self.kinds)):
            if not is_plain(name):  # it could be trained, and its records not be read back
                raise ClipError(f"the {what}'s name {name!r} holds control characters; rename it")
        for camera in self.cameras:
            camera.need_pinhole(f"a clip ({self.name})")
        if self.world is None:
            object.__setattr__(self, "world", World.guessed(self.cameras))

    def __len__(self) -> int:
        return len(self.cameras)

    def __repr__(self) -> str:
        return f"Clip({', '.join(f'{what}: {text}' for what, text in self._facts())})"

    def _repr_html_(self) -> str:
        return html_table(f"Clip {self.name}", ("what", "value"), self._facts())

    def _facts(self) -> list[tuple[str, str]]:
        facts = [("name", self.name)]
        if self.cameras:
            size = f"{self.cameras[0].width}x{self.cameras[0].height}"
            facts.append(("frames", f"{len(self)} of {size} pixels at {self.fps:g} a second"))
        facts += [(part, f"{len(positions)} frames") for part, positions in self.split.items()]
        kinds = [f"{name} ({kind})" for name, kind in self.kinds.items()]
        if len(kinds) > SHOWN:
            kinds = [*kinds[:SHOWN], f"{len(kinds) - SHOWN} more"]
        facts.append(("entities", ", ".join(kinds) or "none"))
        facts.append(("scene points", f"{len(self.points)}"))
        if self.held_out is not None:
            facts.append(("held-out views", f"{len(self.held_out)}"))
        return facts

    @overload
    def __getitem__(self, position: int) -> Frame: ...
    @overload
    def __getitem__(self, position: slice) -> Clip: ...
    def __getitem__(self, position: int | slice) -> Frame | Clip:
        """A frame, or for a slice a clip of its own, whose time runs from 0 to 1 again.

        Tracks and held-out views are cut to the frames from the first to the last of the slice.

        Raises:
            IndexError: there is no such frame, or none in the slice.
            ValueError: the slice runs backwards.
        """
        if isinstance(position, slice):
            return self._cut(position)
        if not -len(self) <= position < len(self):
            raise IndexError(f"frame {position} of a clip with {len(self)} frames")
        position %= len(self)
        return Frame(
            position=position,
            moment=self.moments[position],
            camera=self.cameras[position],
            image=self.store.image(position),
            masks={name: self.store.mask(name, position) for name in self.kinds},
            depth=self.store.depth(position),
            ignored=self.store.ignored(position),
            unknown=frozenset(n for n in self.kinds if not self.store.mask_known(n, position)),
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def _cut(self, part: slice) -> Clip:
        if part.step is not None and part.step < 0:
            raise ValueError(f"clip[::{part.step}]: the frames of a clip go forward in time")
        positions = range(len(self))[part]
        if not positions:
            shown = f"{'' if part.start is None else part.start}:{part.stop}"
            raise IndexError(f"no frame in [{shown}] of a clip with {len(self)} frames")
        kept = [self.moments[p] for p in positions]
        first, last = min(m.index for m in kept), max(m.index for m in kept)
        span = (min(float(m.time) for m in kept), max(float(m.time) for m in kept))
        rows = slice(first, last + 1)
        bodies = {name: track.cut(rows) for name, track in self.bodies.items()}
        objects = {name: track.cut(rows) for name, track in self.objects.items()}
        cut = self._chosen(positions, first, span, bodies, objects)
        held_out = None
        if self.held_out is not None:
            seen = [i for i, m in enumerate(self.held_out.moments) if first <= m.index <= last]
            if seen:
                held_out = self.held_out._chosen(seen, first, span, bodies, objects)
        name = f"{self.name}-{first}-{last}"
        provenance = {**self.provenance, "cut": f"frames {first} to {last} of {self.name}"}
        return replace(cut, name=name, held_out=held_out, provenance=provenance)

    def _chosen(
        self,
        positions: Sequence[int],
        first: int,
        span: tuple[float, float],
        bodies: Mapping[str, BodyTrack],
        objects: Mapping[str, ObjectTrack],
    ) -> Clip:
        """Frames at `positions`; frame `first` gets number 0, and the times `span` become 0, 1."""
        start, length = span[0], span[1] - span[0]
        moments = [
            replace(m, index=m.index - first, time=(float(m.time) - start) / (length or 1.0))
            for m in (self.moments[p] for p in positions)
        ]
        place = {old: new for new, old in enumerate(positions)}
        return replace(
            self,
            store=ChosenStore(self.store, positions),
            cameras=[self.cameras[p] for p in positions],
            moments=moments,
            split={k: [place[p] for p in v if p in place] for k, v in self.split.items()},
            bodies=bodies,
            objects=objects,
        )

    @property
    def num_frames(self) -> int:
        """N_f of the paper: frames of the whole video, held-out views not counted."""
        return max(m.index for m in self.moments) + 1

    @cached_property
    def frame_times(self) -> FrameTimes:
        """The time of every frame number in [0, 1]; None where frames are evenly spaced, or their
        times do not ascend.

        Frame numbers that the clip does not hold lie evenly between their neighbours.
        """
        known = sorted({m.index: float(m.time) for m in self.moments}.items())
        count = self.num_frames
        if all(abs(time - index / max(count - 1, 1)) < EVEN for index, time in known):
            return None
        indices, times = zip(*known, strict=True)
        every = np.interp(np.arange(count), indices, times)
        return tuple(every.tolist()) if (np.diff(every) > 0).all() else None

    def frame(self, position: int) -> Frame:
        return self[position]

    def resized(self, width: int) -> Clip:
        """This clip at another width, aspect kept; pixels are resampled on demand."""
        if width == self.cameras[0].width:
            return self
        sizes = [(width, max(1, round(c.height * width / c.width))) for c in self.cameras]
        return replace(
            self,
            store=ResizedStore(self.store, sizes),
            cameras=[c.resized(*s) for c, s in zip(self.cameras, sizes, strict=True)],
            held_out=self.held_out.resized(width) if self.held_out else None,
        )

    def up(self) -> Float[Tensor, " 3"]:
        """`world.up` as a tensor, unit."""
        return self.world.up_vector()

    def extent(self) -> float:
        """Scene extent, metres: 1.1 x camera spread (Kerbl et al. 2023, arXiv:2308.04079), but at
        least half the median depth of the points, so that a static camera does not give zero."""
        centers = torch.stack([c.center for c in self.cameras])
        spread = 1.1 * float((centers - centers.mean(0)).norm(dim=-1).max())
        if len(self.points) == 0:
            return max(spread, 1.0)
        depth = self.cameras[0].to_camera(self.points)[:, 2]
        ahead = depth[depth > 0]
        return max(spread, 0.5 * float(ahead.median()) if len(ahead) else 1.0)


class OverStore(FrameStore):
    """Another store as it is; subclasses change a part of it."""

    def __init__(self, base: FrameStore) -> None:
        self.base, self.root = base, base.root

    def _at(self, position: int) -> tuple[FrameStore, int]:
        """The store that has a frame, and the frame's position there."""
        return self.base, position

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        store, place = self._at(position)
        return store.image(place)

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        store, place = self._at(position)
        return store.mask(entity, place)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        store, place = self._at(position)
        return store.depth(place)

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        store, place = self._at(position)
        return store.ignored(place)

    def mask_known(self, entity: str, position: int) -> bool:
        store, place = self._at(position)
        return store.mask_known(entity, place)


class ResizedStore(OverStore):
    """Another store at another size: images by area, masks and depth by nearest pixel."""

    def __init__(self, base: FrameStore, sizes: Sequence[tuple[int, int]]) -> None:
        super().__init__(base)
        self.sizes, self._images = sizes, PixelCache(CACHE_MB)

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        return self._images.get(position, lambda: self._resized(position))

    def _resized(self, position: int) -> UInt8[Tensor, "H W 3"]:
        width, height = self.sizes[position]
        image = self.base.image(position).permute(2, 0, 1)[None].float()
        small = torch.nn.functional.interpolate(image, (height, width), mode="area")
        return small[0].permute(1, 2, 0).round().to(torch.uint8).contiguous()

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        return self._nearest(self.base.mask(entity, position).float(), position) > 0.5

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        depth = self.base.depth(position)
        return None if depth is None else self._nearest(depth, position)

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        ignored = self.base.ignored(position)
        return None if ignored is None else self._nearest(ignored.float(), position) > 0.5

    def _nearest(self, image: Tensor, position: int) -> Tensor:
        width, height = self.sizes[position]
        resize = torch.nn.functional.interpolate
        return resize(image[None, None], (height, width), mode="nearest-exact")[0, 0]


class ChosenStore(OverStore):
    """Some frames of another store, in the order of `positions`."""

    def __init__(self, base: FrameStore, positions: Sequence[int]) -> None:
        super().__init__(base)
        self.positions = list(positions)

    def _at(self, position: int) -> tuple[FrameStore, int]:
        return self.base, self.positions[position]


def _stretched(times: tuple[float, ...]) -> FrameTimes:
    """Ascending times, moved and scaled to run from 0 to 1."""
    length = (times[-1] - times[0]) or 1.0
    return tuple((time - times[0]) / length for time in times)


def uniform_test_split(count: int, tests: int = 16) -> dict[str, list[int]]:
    """`tests` uniformly chosen test frames, never the first or last (HOSNeRF's rule: 16)."""
    tests = min(tests, max(1, count // 4))
    chosen = sorted({round((i + 0.5) * count / tests) for i in range(tests)})
    chosen = [min(max(1, c), count - 2) for c in chosen] if count > 2 else []
    test = sorted(set(chosen))
    return {"train": [i for i in range(count) if i not in set(test)], "test": test}
