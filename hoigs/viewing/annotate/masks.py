"""The mask that clicks and boxes in a frame give, at once: as the object tracker would begin."""

from __future__ import annotations

import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityRequest,
    FramePrompt,
    LazyFrames,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.mediapipe.estimator import MediapipeEstimator
from hoigs.plugins.estimators.object_tracker.footage import Footage, read_footage
from hoigs.plugins.estimators.object_tracker.motion import BESIDE
from hoigs.plugins.estimators.object_tracker.outlined import clicked_mask
from hoigs.plugins.estimators.object_tracker.outlines import Outlines
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask
from hoigs.plugins.estimators.object_tracker.scene import (
    NEIGHBOURS,
    Scene,
    StaticScene,
    is_static,
    moving_scene,
    static_scene,
)
from hoigs.plugins.estimators.object_tracker.tracker import color_model
from hoigs.plugins.estimators.tools import MEDIAPIPE
from hoigs.preparation.kept import last_kept
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.prepare import work_folder
from hoigs.preparation.video.pictures import resized_mask
from hoigs.viewing.annotate.video import ScrubbedVideo

SIZE = 640  # pixels of the longer side, as the tracker's default
SAMPLES = 24  # frames of which a still scene is the median
KEPT = 24  # frames that are kept for further clicks
Person = Callable[[int], Bool[np.ndarray, "H W"] | None]


@dataclass(frozen=True)
class ClickedMask:
    """A mask at the tracker's size.

    Attributes:
        soft: probability of each pixel. note: what is doubtful, a sentence, or "".
    """

    soft: Float[np.ndarray, "h w"]
    note: str = ""


@dataclass(frozen=True)
class _Known:
    """The scene behind one frame."""

    away: Float[np.ndarray, "h w"]

    def difference(self, i: int) -> Float[np.ndarray, "h w"]:
        return self.away


@dataclass(frozen=True)
class _Still:
    """One frame to grow masks in: its position in `footage`, and the scene behind it."""

    footage: Footage
    scene: Scene
    row: int

    @staticmethod
    def of(footage: Footage, scene: Scene, row: int) -> _Still:
        """With the frame's difference from the scene computed, which every mask begins with."""
        return _Still(footage, _Known(scene.difference(row)), row)

    def alone(self) -> Footage:
        """This frame only, of which the colours are learned."""
        part, row = self.footage, slice(self.row, self.row + 1)
        return replace(
            part, numbers=part.numbers[row], lab=part.lab[row], person=part.person[row],
            blank=part.blank[row], held=part.held[row],
        )  # fmt: skip


class ClickMasks:
    """Masks from prompts, a frame at a time, without reading the whole video.

    With a still camera the scene is the median of some frames; with a moving one, the frames around
    the clicked one are read. Threads may share it; one mask is made at a time.

    Args:
        person: a frame's number to the person's mask at any size, or None where it is not
            known.
    """

    def __init__(self, video: ScrubbedVideo, person: Person = lambda frame: None) -> None:
        self.video, self.person = video, person
        self._lock = threading.Lock()
        self._stills: OrderedDict[int, _Still] = OrderedDict()
        self._made_before: OrderedDict[tuple[FramePrompt, ...], PromptedMask] = OrderedDict()
        self._still_scene: StaticScene | None = None
        self._surveyed = False
        self._scale = min(1.0, SIZE / max(video.width, video.height))
        width = round(video.width * self._scale)
        self.size = (width, max(1, round(video.height * width / video.width)))
        self._outlines = (
            Outlines((self.size[1], self.size[0]), video.rgb) if Outlines.installed() else None
        )

    def close(self) -> None:
        if self._outlines is not None:
            self._outlines.close()

    def survey(self) -> None:
        """Looks at the scene; the first mask does it otherwise."""
        with self._lock:
            self._survey()

    def forget(self, frame: int | None = None) -> None:
        """The person of a frame, or of all frames, is known now: it is looked at again."""
        with self._lock:
            for number in [frame] if frame is not None else list(self._stills):
                self._stills.pop(number, None)
            self._made_before.clear()

    def look_at(self, frame: int) -> None:
        """Compute what masks from clicks need in this frame, before the first click."""
        with self._lock:
            self._survey()
            self._still(frame)

    def mask(self, prompts: Sequence[FramePrompt], frame: int) -> ClickedMask | None:
        """The mask in a frame with a prompt; None where it has none.

        Prompts of earlier frames give the object's colours, as when the object is tracked.
        """
        with self._lock:
            self._survey()
            ordered = tuple(sorted(prompts, key=lambda p: p.frame))
            # only points beside it: there is nothing to grow from
            usable = [
                _scaled(p, self._scale) for p in ordered if p.box or any(q.inside for q in p.points)
            ]
            done: list[tuple[_Still, PromptedMask]] = []
            for k, prompt in enumerate(usable):
                if prompt.frame > frame:
                    break
                still = self._still(prompt.frame)
                found = self._grown(still, tuple(usable[: k + 1]), done)
                if prompt.frame == frame:
                    return ClickedMask(found.soft, _note(found))
                if (found.soft > 0.5).any():
                    done.append((still, found))
        return None

    def _grown(
        self,
        still: _Still,
        prompts: tuple[FramePrompt, ...],
        done: list[tuple[_Still, PromptedMask]],
    ) -> PromptedMask:
        """The mask of the last prompt; `done`: those of the ones before."""
        found = self._made_before.get(prompts)
        if found is None:
            colors = _colors(done) if done else None
            found = clicked_mask(
                still.footage, still.scene, still.row, prompts[-1], colors, self._outlines
            )
            self._made_before[prompts] = found
            if len(self._made_before) > 2 * KEPT:
                self._made_before.popitem(last=False)
        return found

    def _survey(self) -> None:
        if self._surveyed:
            return
        count, keys = self.video.count, self.video.keyframes
        # keyframes decode at once: in a long video they are as good as any others
        among = keys if len(keys) >= SAMPLES else range(count)
        picks = np.unique(np.linspace(0, len(among) - 1, SAMPLES).astype(int))
        footage = self._read([int(among[i]) for i in picks])
        if is_static(footage):
            self._still_scene = static_scene(footage)
        self._surveyed = True

    def _still(self, frame: int) -> _Still:
        found = self._stills.get(frame)
        if found is None:
            found = self._made(frame)
            self._stills[frame] = found
            if len(self._stills) > (KEPT if self._still_scene else 3):
                self._stills.popitem(last=False)
        return found

    def _made(self, frame: int) -> _Still:
        if self._still_scene is not None:
            beside = sorted({frame, *(frame + way * n for n, _ in BESIDE for way in (-1, 1))})
            footage = self._read([n for n in beside if 0 <= n < self.video.count])
            scene = replace(self._still_scene, footage=footage)
            return _Still.of(footage, scene, footage.numbers.index(frame))
        first = max(0, frame + NEIGHBOURS[0])
        numbers = list(range(first, min(self.video.count, frame + NEIGHBOURS[-1] + 1)))
        footage = self._read(numbers)
        return _Still.of(footage, moving_scene(footage), frame - first)

    def _read(self, numbers: Sequence[int]) -> Footage:
        width, height = self.size
        known = {
            n: resized_mask(mask, self.size)
            for n in numbers
            if (mask := self.person(n)) is not None
        }
        nobody = np.zeros((height, width), bool)
        request = VideoRequest(
            frames=self.video.count, width=width, height=height, folder=Path(), work=Path(),
            read=lambda n: self.video.rgb(n, width), wanted=tuple(numbers),
        )  # fmt: skip
        person = LazyFrames(self.video.count, lambda n: known.get(n, nobody)) if known else None
        return read_footage(request, person, longest=SIZE)


def _scaled(prompt: FramePrompt, s: float) -> FramePrompt:
    points = tuple(PromptPoint(p.x * s, p.y * s, p.inside) for p in prompt.points)
    box = None if prompt.box is None else tuple(s * v for v in prompt.box)
    return FramePrompt(prompt.frame, points, box)  # type: ignore[arg-type]


def _colors(done: Sequence[tuple[_Still, PromptedMask]]):
    """What is known of the object's colours from masks in other frames."""
    parts = [still.alone() for still, _ in done]
    joined = replace(
        parts[0], numbers=tuple(n for p in parts for n in p.numbers),
        lab=np.concatenate([p.lab for p in parts]),
        person=np.concatenate([p.person for p in parts]),
        blank=np.concatenate([p.blank for p in parts]),
        held=np.concatenate([p.held for p in parts]),
    )  # fmt: skip
    return color_model(joined, {row: found.soft for row, (_, found) in enumerate(done)})


def _note(found: PromptedMask) -> str:
    if not (found.soft > 0.5).any():
        return "nothing with an outline is there: click on the middle of it, or draw a box"
    return ""


# The person's mask in one frame, by MediaPipe if its environment is installed.

KEPT_PEOPLE = 40
NAME = "human"


class FoundPeople:
    """Finds the person in single frames, which takes some seconds each, and keeps the masks."""

    def __init__(self, video: ScrubbedVideo) -> None:
        self.video = video
        self._found: dict[int, tuple[FramePrompt | None, Bool[np.ndarray, "H W"]]] = {}
        self._lock = threading.Lock()

    @property
    def available(self) -> bool:
        return MEDIAPIPE.installed

    def known(self, frame: int) -> Bool[np.ndarray, "H W"] | None:
        """The mask, if the frame was looked at."""
        found = self._found.get(frame)
        return None if found is None else found[1]

    def find(self, frame: int, prompt: FramePrompt | None = None) -> Bool[np.ndarray, "H W"]:
        """The mask of the person at the prompt, without one of whom MediaPipe takes; empty where
        that is nobody.

        Raises:
            HoigsError: MediaPipe is not installed, finds nobody at the prompt, or failed.
        """
        with self._lock:
            found = self._found.get(frame)
            if found is None or prompt not in (None, found[0]):
                found = prompt, self._estimated(frame, prompt)
                while len(self._found) >= KEPT_PEOPLE:
                    self._found.pop(next(iter(self._found)))
                self._found[frame] = found
            return found[1]

    def _estimated(self, frame: int, prompt: FramePrompt | None) -> Bool[np.ndarray, "H W"]:
        video = self.video
        points, box = ((), None) if prompt is None else (prompt.points, prompt.box)
        person = EntityRequest(NAME, "human", points=points, box=box)
        pixels = video.rgb(frame)
        with tempfile.TemporaryDirectory(prefix="hoigs-annotate-") as work:
            request = VideoRequest(
                frames=1, width=video.width, height=video.height, read=lambda _: pixels,
                folder=Path(work), work=Path(work), entities=(person,),
            )  # fmt: skip
            masks = MediapipeEstimator().estimate(request).masks
            if masks is None:
                raise HoigsError("MediaPipe gave no mask")
            return np.asarray(masks.entities[NAME][0])


# Masks that a preparation has found in all frames, read from its work folder.


class TrackedMasks:
    """By entity, the mask in each frame of the video that was tracked.

    Attributes:
        confidence: of each entity by frame, 0..1, or 1 where its estimator gives none; 0: it is not
            seen. None: not tracked there.

    Args:
        out: the clip of the preparation; `object_name`, `human` are the entities' names in it.
    """

    def __init__(self, out: Path, object_name: str, human: str) -> None:
        self._stacks: dict[str, MaskStack] = {}
        self._rows: dict[int, int] = {}
        self.confidence: dict[str, list[float | None]] = {}
        root = work_folder(out)
        frames = last_kept(root, "frames").get("frames")
        if frames is None:
            return
        self._rows = {number: row for row, number in enumerate(frames.indices)}
        estimates = last_kept(root, "estimates").get("estimates")
        found = last_kept(root, "object_masks").get("found_object")
        if estimates is not None:
            masks = estimates.masks
            people = masks.human if masks.human is not None else masks.together
            for name, stack in ((human, people), (object_name, masks.object)):
                if stack is not None:
                    self._stacks[name] = stack
            self._stacks |= estimates.further
        sure: dict[str, np.ndarray | None] = {}
        if found is not None:
            for name, thing in {object_name: found, **found.further}.items():
                self._stacks[name], sure[name] = thing.masks, thing.confidence
        for name, stack in self._stacks.items():
            seen = stack.bits.any(axis=(1, 2)).astype(float)
            given = sure.get(name)
            self.confidence[name] = _by_frame(seen if given is None else given * seen, self._rows)

    def names(self) -> list[str]:
        """Entities that have masks."""
        return list(self._stacks)

    def mask(self, name: str, frame: int) -> Bool[np.ndarray, "H W"] | None:
        """The mask at the size of the prepared frames; None where there is none."""
        stack, row = self._stacks.get(name), self._rows.get(frame)
        return None if stack is None or row is None or row >= len(stack) else stack[row]


def _by_frame(values: np.ndarray, rows: dict[int, int]) -> list[float | None]:
    """By frame of the video, rounded for the page; None where it was not tracked."""
    count = max(rows, default=-1) + 1
    found: list[float | None] = [None] * count
    for frame, row in rows.items():
        if row < len(values) and np.isfinite(values[row]):
            found[frame] = round(float(values[row]), 2)
    return found
