"""Videos, and folders of frames, to RGB: streamed, any number of passes, one frame in memory."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import UInt8

from hoigs.core.system.video_files import pyav
from hoigs.preparation.video.container import PacketIndex, open_video, packet_index, unreadable
from hoigs.preparation.video.pictures import FilePicture, Picture, VideoPicture, sharpness
from hoigs.preparation.video.source import IMAGE_SUFFIXES, SourceError, numbered_frames
from hoigs.preparation.video.span import Pick, Span

UNEVEN = 0.1  # of the gap between frames: times that are so far from even ones are kept
FAR = 30  # frames ahead, from which on decoding begins anew at a keyframe
SHARPER = 1.4  # times as sharp as the first of a window: its blur is seen
LATE = 0.05  # of a window: a frame this little before it belongs to it, for times are rounded


@dataclass(frozen=True)
class FrameList:
    """What a survey of a source found.

    Attributes:
        native_width, native_height: of the source as displayed (rotation applied).
        rate: frames a second of the source. fps: of the chosen ones.
        total: frames in the source, up to the last one looked at.
        indices: frame number of each chosen one.
        sharpness: of each chosen one; see `sharpness.sharpness`.
        times: of each chosen one, seconds since the source's first frame.
        first: number of the first frame that could be chosen.
    """

    native_width: int
    native_height: int
    rate: float
    fps: float
    total: int
    indices: list[int]
    sharpness: list[float]
    times: list[float] = field(default_factory=list)
    first: int = 0


@dataclass(frozen=True)
class Choice:
    """Which frames of a source are chosen.

    Attributes:
        every: one frame of each window of so many. max_frames: stop after so many; None takes all.
        fps: frames a second to choose, in place of `every`.
        pick: which frame of a window: its first, or its sharpest.
        span: the part of the source to choose from.
        folder_fps: frames a second of a source that has no rate of its own.
    """

    every: int = 1
    max_frames: int | None = None
    fps: float | None = None
    pick: Pick = "first"
    span: Span = field(default_factory=Span)
    folder_fps: float = 30.0


class Frames(ABC):
    """The chosen frames of a source, read anew on every iteration.

    Args:
        path: the source.
        width: of the frames given out, pixels; None keeps the source's. Height follows.
        choice: which frames.
        known: what an earlier survey found; the source is then not looked at again.

    Attributes:
        native_width, native_height: of the source as displayed (rotation applied).
        width, height: of the frames given out.
        fps: of the frames given out, `every` allowed for; the mean of uneven ones.
        times: of the frames given out, seconds since the source's first frame. uneven: whether
            they are not `fps` frames a second, evenly. variable: whether those of the source are
            not evenly spaced, either.
        indices: the source's frame number of each frame given out.
        total: frames in the source, up to the last one looked at.
        sharpness: of each frame given out.
        notes: what went another way than it should while frames were read, a sentence each.

    Raises:
        SourceError: the source is no video, is empty, or is damaged.
    """

    def __init__(
        self,
        path: Path,
        width: int | None = None,
        choice: Choice = Choice(),
        *,
        known: FrameList | None = None,
    ) -> None:
        self.path, self._rate = Path(path), choice.folder_fps
        self.notes: list[str] = []
        self.list = known or self._survey(_Windows(choice), choice.span)
        if width and width > self.native_width:
            raise SourceError(
                f"width {width} is larger than the video's {self.native_width}; "
                "frames are not enlarged"
            )
        self.width = width or self.native_width
        self.height = max(1, round(self.native_height * self.width / self.native_width))
        self._reading: tuple[int, Iterator[Picture]] | None = None

    native_width = property(lambda self: self.list.native_width)
    native_height = property(lambda self: self.list.native_height)
    times = property(lambda self: self.list.times)
    total = property(lambda self: self.list.total)
    indices = property(lambda self: self.list.indices)
    sharpness = property(lambda self: self.list.sharpness)

    @property
    def uneven(self) -> bool:
        times = np.array(self.times)
        if len(times) < 3:
            return False
        even = np.linspace(times[0], times[-1], len(times))
        return bool(np.abs(times - even).max() > UNEVEN * (even[1] - even[0]))

    @property
    def variable(self) -> bool:
        """Whether the source's own frames are not evenly spaced, whichever were chosen of them."""
        times, numbers = np.array(self.times), np.array(self.indices)
        if len(times) < 3:
            return False
        step = (times[-1] - times[0]) / (numbers[-1] - numbers[0])
        even = times[0] + step * (numbers - numbers[0])
        return bool(np.abs(times - even).max() > UNEVEN * step)

    @property
    def fps(self) -> float:
        if not self.uneven:
            return self.list.fps
        return (len(self.times) - 1) / (self.times[-1] - self.times[0])

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        for picture in self._chosen():
            yield picture.rgb(self.width, self.height)

    def subset(self, positions: Sequence[int]) -> Self:
        """Only some of the chosen frames, by their place among them."""
        part = copy.copy(self)
        part.list = replace(
            self.list,
            indices=[self.indices[i] for i in positions],
            sharpness=[self.sharpness[i] for i in positions],
            times=[self.times[i] for i in positions],
        )
        part._reading = None
        return part

    def read(self, number: int) -> UInt8[np.ndarray, "H W 3"]:
        """Frame `number` of the source at its own size; going forwards is the cheap way."""
        at, stream = self._reading or (-1, None)
        if stream is None or not at < number <= at + FAR:
            at, stream = number - 1, self._pictures(number)
        for picture in stream:
            at += 1
            if at == number:
                self._reading = at, stream
                return picture.rgb(self.native_width, self.native_height)
        raise SourceError(f"{self.path} has {self.count()} frames, none of number {number}")

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)

    def count(self) -> int:
        """Frames of the whole source, those beyond the last chosen one too."""
        return sum(1 for _ in self._pictures())

    @abstractmethod
    def _pictures(self, first: int = 0) -> Iterator[Picture]:
        """The frames of the source from `first` on, in order; sets `_rate` where the source has
        one."""

    def _begin(self, span: Span) -> tuple[int, float]:
        """Number of a frame from which a survey finds the span's first one, and seconds of the
        source's first frame by its own clock."""
        return 0, 0.0

    def _chosen(self) -> Iterator[Picture]:
        wanted, first, last = set(self.indices), self.indices[0], self.indices[-1]
        for number, picture in enumerate(self._pictures(first), first):
            if number in wanted:
                yield picture
            if number == last:
                return

    def _survey(self, windows: _Windows, span: Span) -> FrameList:
        """Looks at every frame of the span, so that damage shows before any work."""
        native: tuple[int, int] | None = None
        start, begun = self._begin(span)
        count, seconds = 0, -1.0
        first: int | None = None
        for number, picture in enumerate(self._pictures(start), start):
            windows.rate = self._rate
            native = native or picture.size()
            if picture.size() != native:
                raise SourceError(
                    f"{self.path}: frame {number} is {picture.size()[0]}x{picture.size()[1]}, "
                    f"the first {native[0]}x{native[1]}; a clip has one size"
                )
            begun = (picture.seconds or 0.0) if number == 0 else begun
            shown = None if picture.seconds is None else picture.seconds - begun
            if shown is None or shown <= seconds:  # no clock, or a broken one
                shown = number / self._rate if shown is None else seconds + 1 / self._rate
            if span.over(number, shown):
                break
            if span.begun(number, shown):
                first = number if first is None else first
                if not windows.offer(number, shown, picture):
                    break
            count, seconds = number + 1, shown
        if native is None:
            raise SourceError(f"{self.path} holds no video frame: it is empty or cut off")
        if first is None:
            raise SourceError(
                f"{span} leaves no frame of {self.path}: it has frames 0 to {count - 1}, the last "
                f"at {max(seconds, 0):.2f} s"
            )
        return FrameList(
            *native, self._rate, windows.fps(), count, windows.indices, windows.sharpnesses,
            windows.times, first,
        )  # fmt: skip


class _Windows:
    """Cuts a stream of frames into windows, the first of which begins with the first frame, and
    keeps one frame of each."""

    def __init__(self, choice: Choice) -> None:
        self.every, self.wanted_fps = choice.every, choice.fps
        self.max_frames, self.pick = choice.max_frames, choice.pick
        self.rate = 0.0
        self.indices: list[int] = []
        self.sharpnesses: list[float] = []
        self.times: list[float] = []
        self._begun: tuple[int, float] | None = None
        self._window = -1
        self._first = 0.0  # sharpness of the window's first frame

    def fps(self) -> float:
        return self.rate / self.every if self.wanted_fps is None else self.wanted_fps

    def _of(self, number: int, seconds: float) -> int:
        self._begun = self._begun or (number, seconds)
        if self.wanted_fps is None:
            return (number - self._begun[0]) // self.every
        if self.wanted_fps > 1.01 * self.rate:
            raise SourceError(
                f"fps {self.wanted_fps:g} is more than the video's {self.rate:g}; "
                "frames are not invented"
            )
        return int((seconds - self._begun[1]) * self.wanted_fps + LATE)

    def offer(self, number: int, seconds: float, picture: Picture) -> bool:
        """Takes the frame, or not; False if neither it nor any later one can be chosen."""
        window = self._of(number, seconds)
        new = window != self._window
        if new and self.max_frames is not None and len(self.indices) >= self.max_frames:
            return False
        if not new and self.pick == "first":
            return True
        self._window = window
        value = sharpness(picture)
        # frames at even steps are left for those alone that are clearly sharper
        if not new and value <= max(self.sharpnesses[-1], SHARPER * self._first):
            return True
        self._first = value if new else self._first
        at = len(self.indices) if new else len(self.indices) - 1
        self.indices[at:], self.sharpnesses[at:], self.times[at:] = [number], [value], [seconds]
        return True


class VideoFrames(Frames):
    """The chosen frames of a video file, decoded anew on every iteration from the nearest keyframe
    on."""

    _indexed: tuple[PacketIndex | None] | None = None  # in a tuple once it has been looked for

    def count(self) -> int:
        index = self._index()
        return super().count() if index is None else len(index)

    def _begin(self, span: Span) -> tuple[int, float]:
        index = None if span.start is None else self._index()
        if index is None or span.start is None:
            return 0, 0.0
        for number in range(len(index)):
            if span.begun(number, index.seconds(number)):
                return number, index.times[0] * index.tick
        return 0, 0.0  # beyond the end, which the survey says

    def _index(self) -> PacketIndex | None:
        if self._indexed is None:
            with self._opened() as (container, stream):
                self._indexed = (packet_index(container, stream),)
        return self._indexed[0]

    def _pictures(self, first: int = 0) -> Iterator[Picture]:
        index = self._index() if first else None
        with self._opened() as (container, stream):
            if index is not None and index.keyframe(first):
                yield from self._sought(container, stream, index, first)
            else:
                yield from _pictures(container, stream, first)

    def _sought(
        self, container: Any, stream: Any, index: PacketIndex, first: int
    ) -> Iterator[Picture]:
        """Pictures from `first` on, by their times; decoded from the start, with a note, if they
        are not found from the keyframe."""
        container.seek(index.times[index.keyframe(first)], stream=stream, backward=True)
        expected = first
        for frame in container.decode(stream):
            number = index.number(frame.pts)
            if expected == first and (number is None or number < first):
                continue
            if number != expected:
                break
            expected += 1
            yield VideoPicture(frame, stream.sample_aspect_ratio)
        if expected < len(index):  # times of packets and of frames differ, or frames are damaged
            self._note(
                f"frame {expected} of {self.path.name} is not where the video's index has it: "
                "frames are decoded from the start, which takes longer and may shift them where "
                "frames are damaged; re-encode it, such as with `ffmpeg -i VIDEO -c:v libx264 "
                "fixed.mp4`"
            )
            with self._opened() as (anew, video):
                yield from _pictures(anew, video, expected)

    @contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        """The file and its video stream; errors of the decoder are named."""
        av = pyav()

        container, stream = open_video(self.path)
        try:
            with container:
                self._rate = float(stream.average_rate or stream.guessed_rate or 30)
                yield container, stream
        except (av.error.FFmpegError, ValueError) as error:
            raise unreadable(self.path, error) from error


def _pictures(container: Any, stream: Any, first: int) -> Iterator[Picture]:
    for frame in islice(container.decode(stream), first, None):
        yield VideoPicture(frame, stream.sample_aspect_ratio)


class FolderFrames(Frames):
    """The chosen images of a folder in the order of their names, which end in a number."""

    def _pictures(self, first: int = 0) -> Iterator[Picture]:
        return map(FilePicture, self._paths()[first:])

    def _chosen(self) -> Iterator[Picture]:
        paths = self._paths()
        return (FilePicture(paths[number]) for number in self.indices)

    def _paths(self) -> list[Path]:
        paths = numbered_frames(self.path)
        if not paths:
            raise SourceError(f"{self.path} holds no images ({', '.join(IMAGE_SUFFIXES)})")
        return paths


def open_frames(
    path: Path,
    width: int | None = None,
    choice: Choice = Choice(),
    *,
    known: FrameList | None = None,
) -> Frames:
    """A video file's or a folder's frames; see `Frames`."""
    kind = FolderFrames if Path(path).is_dir() else VideoFrames
    return kind(path, width, choice, known=known)
