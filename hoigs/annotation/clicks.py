"""The mask that clicks and boxes in a frame give, at once: as the object tracker would begin."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from hoigs.annotation.video import ScrubbedVideo
from hoigs.core.interfaces.estimator import FramePrompt, LazyFrames, PromptPoint, VideoRequest
from hoigs.plugins.estimators.object_tracker.pixels.camera_motion import is_static
from hoigs.plugins.estimators.object_tracker.pixels.footage import Footage, read_footage
from hoigs.plugins.estimators.object_tracker.pixels.scene import (
    NEIGHBOURS,
    Scene,
    StaticScene,
    moving_scene,
    static_scene,
)
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, prompted_mask
from hoigs.plugins.estimators.object_tracker.tracker import color_model
from hoigs.preparation.video.resizing import resized_mask

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
        del i
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
            blank=part.blank[row],
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
        """Makes ready for clicks in a frame."""
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
            found = prompted_mask(still.footage, still.scene, still.row, prompts[-1], colors)
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
            footage = self._read([frame])
            return _Still.of(footage, replace(self._still_scene, footage=footage), 0)
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
    )  # fmt: skip
    return color_model(joined, {row: found.soft for row, (_, found) in enumerate(done)})


def _note(found: PromptedMask) -> str:
    if not (found.soft > 0.5).any():
        return "nothing with an outline is there: click on the middle of it, or draw a box"
    return ""
