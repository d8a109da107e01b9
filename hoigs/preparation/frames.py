"""Video files to RGB frames, streamed: any number of passes, one frame in memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from hoigs.preparation.source import SourceError


class VideoFrames:
    """The chosen frames of a video, decoded anew on every iteration.

    Args:
        path: the video.
        width: of the frames given out, pixels; None keeps the video's. Height follows.
        every: take every n-th frame. max_frames: stop after so many; None takes all.

    Attributes:
        native_width, native_height: of the video as displayed (rotation applied).
        width, height: of the frames given out.
        fps: of the frames given out, `every` allowed for.
        indices: the video frame number of each frame given out.
        total: frames in the video, up to the last one taken.

    Raises:
        SourceError: the file is no video, is empty, or is damaged.
    """

    def __init__(
        self,
        path: Path,
        width: int | None = None,
        every: int = 1,
        max_frames: int | None = None,
    ) -> None:
        self.path, self.every, self.max_frames = Path(path), every, max_frames
        self.native_width = self.native_height = 0
        self._size: tuple[int, int] | None = None
        rate = self._survey()
        self.fps = rate / every
        self.width = width or self.native_width
        self.height = max(1, round(self.native_height * self.width / self.native_width))
        if self.width > self.native_width:
            raise SourceError(
                f"width {self.width} is larger than the video's {self.native_width}; "
                "frames are not enlarged"
            )
        self._size = (self.width, self.height)

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        for frame in self._chosen():
            yield self._rgb(frame)

    def _survey(self) -> float:
        """Counts frames by decoding them, so that damage shows before any work; frame rate."""
        self.indices: list[int] = []
        count = 0
        for count, frame in enumerate(self._decoded(), start=1):
            if not self.native_width:
                turned = _quarter_turns(frame) % 2
                size = (frame.height, frame.width) if turned else (frame.width, frame.height)
                self.native_width, self.native_height = size
            if (count - 1) % self.every == 0:
                self.indices.append(count - 1)
            if self.max_frames and len(self.indices) == self.max_frames:
                break
        if not count:
            raise SourceError(f"{self.path} holds no video frame: it is empty or cut off")
        self.total = count
        return self._rate

    def _decoded(self) -> Iterator:
        import av

        try:
            with av.open(str(self.path)) as container:
                if not container.streams.video:
                    raise SourceError(f"{self.path} has no video stream")
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                self._rate = float(stream.average_rate or stream.guessed_rate or 30)
                yield from container.decode(stream)
        except (av.error.FFmpegError, ValueError) as error:
            size = self.path.stat().st_size if self.path.exists() else 0
            raise SourceError(
                f"{self.path} ({size} bytes) is not a readable video: {error}; "
                "re-encode it, for example with `ffmpeg -i VIDEO -c:v libx264 fixed.mp4`"
            ) from error

    def _chosen(self) -> Iterator:
        last = self.indices[-1]
        for number, frame in enumerate(self._decoded()):
            if number % self.every == 0:
                yield frame
            if number == last:
                return

    def _rgb(self, frame) -> UInt8[np.ndarray, "H W 3"]:
        turns = _quarter_turns(frame)
        width, height = (self.height, self.width) if turns % 2 else (self.width, self.height)
        if (width, height) != (frame.width, frame.height):
            frame = frame.reformat(width=width, height=height, interpolation="AREA")
        pixels = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(pixels, turns)) if turns else pixels


def _quarter_turns(frame) -> int:
    """Counter-clockwise quarter turns that set the frame upright; phones store them apart."""
    return round(getattr(frame, "rotation", 0) / 90) % 4
