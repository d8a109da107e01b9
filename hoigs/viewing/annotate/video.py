"""Any frame of a video, decoded when it is looked at."""

from __future__ import annotations

import bisect
import io
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from hoigs.core.system.video_files import pyav
from hoigs.preparation.video.container import open_video, packet_index
from hoigs.preparation.video.pictures import FilePicture, Picture, VideoPicture
from hoigs.preparation.video.source import SourceError, numbered_frames

ENCODED_BYTES = 96_000_000  # of encoded frames that are kept
DECODED_BYTES = 64_000_000  # and of decoded ones, so that going backwards is fast, too
CURSORS = 3  # places that are decoded from at once: what is looked at, thumbnails, the scene


class _Cursor:
    """A decoder, and where in the video it is."""

    def __init__(self, path: Path) -> None:
        self.lock = threading.Lock()
        self.at = -1  # the frame that was decoded last
        self.used = 0.0  # when
        self.container, self.video = open_video(path)
        self.frames: Iterator[Any] = self.container.decode(self.video)

    def seek(self, time: int, before: int) -> None:
        """To the keyframe of this time; `before` is the number of the frame before it."""
        self.container.seek(time, stream=self.video, backward=True)
        self.frames, self.at = self.container.decode(self.video), before


class ScrubbedVideo:
    """Frames of a video file, or of a folder of images, in any order; threads may share it.

    Frames have the numbers that `Frames` gives them: the order in which they are shown. A list of
    their times is read from the container first, without decoding; then the nearest keyframe
    before a wanted frame is looked up and decoded from there.

    Attributes:
        count: number of frames. width, height: as displayed (rotation applied).
        fps: frames a second, the mean. keyframes: numbers of frames that decode at once.

    Raises:
        SourceError: the file is no video, or has no frames.
    """

    def __init__(self, path: Path, folder_fps: float = 30.0) -> None:
        self.path, self.fps = Path(path), folder_fps
        self._lock, self._converting = threading.Lock(), threading.Lock()
        self._pictures: OrderedDict[int, Picture] = OrderedDict()
        self._encoded: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._cursors: list[_Cursor] = []
        self._times: list[int] = []
        self._files: list[Path] = []
        if self.path.is_dir():
            self._files = numbered_frames(self.path)
            self.count, self.keyframes = len(self._files), list(range(len(self._files)))
        else:
            self._index()
        if not self.count:
            raise SourceError(f"{self.path} holds no video frame: it is empty or cut off")
        self._most = 8
        self.width, self.height = self.picture(0).size()
        self._most = max(4, DECODED_BYTES // (self.width * self.height * 2))

    def picture(self, number: int) -> Picture:
        """One frame.

        Raises:
            SourceError: there is no such frame, or it cannot be decoded.
        """
        if not 0 <= number < self.count:
            raise SourceError(f"there is no frame {number}: {self.path} has 0 to {self.count - 1}")
        with self._lock:
            found = self._pictures.get(number)
        if found is None:
            found = FilePicture(self._files[number]) if self._files else self._decoded(number)
            self._keep(number, found)
        return found

    def rgb(self, number: int, width: int | None = None) -> UInt8[np.ndarray, "H W 3"]:
        """Pixels of one frame, `width` wide; None: at the video's own size."""
        width = self.width if width is None else min(width, self.width)
        picture, height = self.picture(number), max(1, round(self.height * width / self.width))
        with self._converting:  # a decoded frame keeps its converter, which is not for two threads
            return picture.rgb(width, height)

    def jpeg(self, number: int, width: int) -> bytes:
        """One frame, encoded; those looked at lately are kept."""
        key = (number, width)
        with self._lock:
            found = self._encoded.get(key)
            if found is not None:
                self._encoded.move_to_end(key)
                return found
        file = io.BytesIO()
        Image.fromarray(self.rgb(number, width)).save(file, "JPEG", quality=88)
        with self._lock:
            self._encoded[key] = file.getvalue()
            while sum(map(len, self._encoded.values())) > ENCODED_BYTES:
                self._encoded.popitem(last=False)
        return file.getvalue()

    def close(self) -> None:
        for cursor in self._cursors:
            with cursor.lock:
                cursor.container.close()
        self._cursors = []

    def _keep(self, number: int, picture: Picture) -> None:
        with self._lock:
            self._pictures[number] = picture
            self._pictures.move_to_end(number)
            while len(self._pictures) > self._most:
                self._pictures.popitem(last=False)

    def _index(self) -> None:
        """Times and keyframes, by the container's packets; where they have none, by decoding."""
        cursor = _Cursor(self.path)
        rate = cursor.video.average_rate or cursor.video.guessed_rate or 30
        self.fps = float(rate)
        index = packet_index(cursor.container, cursor.video)
        cursor.container.close()
        if index is not None:
            self._times, self.count, self.keyframes = index.times, len(index), index.keyframes
        else:  # frames are found by counting
            self.count, self.keyframes = sum(1 for _ in _Cursor(self.path).frames), [0]

    def _decoded(self, number: int) -> Picture:
        """Decodes a frame, keeping those on the way."""
        av = pyav()

        start = self.keyframes[max(0, bisect.bisect_right(self.keyframes, number) - 1)]
        cursor = self._cursor(number, start)
        with cursor.lock:
            try:
                if not (start - 1 <= cursor.at < number):
                    if self._times:
                        cursor.seek(self._times[start], start - 1)
                    else:
                        self._cursors.remove(cursor)
                        cursor = _Cursor(self.path)
                        self._cursors.append(cursor)
                for frame in cursor.frames:
                    cursor.at = self._number(frame, cursor.at)
                    picture = VideoPicture(frame, cursor.video.sample_aspect_ratio)
                    if cursor.at >= number:
                        return picture
                    if cursor.at > number - self._most // 2:
                        self._keep(cursor.at, picture)
            except (av.error.FFmpegError, ValueError) as error:
                reason = str(error)
            else:
                reason = "the file is cut off"
            cursor.at = self.count  # the next use seeks
        raise SourceError(f"{self.path}: frame {number} cannot be decoded: {reason}")

    def _cursor(self, number: int, start: int) -> _Cursor:
        """The one that is nearest before a frame, or else the one that was not used for longest."""
        with self._lock:
            ahead = [c for c in self._cursors if start <= c.at < number]
            if ahead:
                found = max(ahead, key=lambda c: c.at)
            elif len(self._cursors) < CURSORS:
                found = _Cursor(self.path)
                self._cursors.append(found)
            else:
                found = min(self._cursors, key=lambda c: c.used)
            found.used = time.monotonic()
            return found

    def _number(self, frame: Any, before: int) -> int:
        """Of a decoded frame, by its time."""
        if not self._times or frame.pts is None:
            return before + 1
        return bisect.bisect_left(self._times, frame.pts)
