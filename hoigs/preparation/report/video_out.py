"""RGB frames to an mp4 that browsers play."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from hoigs.core.files.video_files import coded, declare_colors


class VideoWriter:
    """H.264, yuv420p; an odd last row or column is dropped, as the format demands.

    >>> with VideoWriter("overlay.mp4", fps=24) as video:
    ...     video.add(image)

    Args:
        path: to write. fps: frames a second. crf: quality, lower is better (18 is near lossless).
    """

    def __init__(self, path: str | Path, fps: float | int, crf: int = 23) -> None:
        self.path, self.fps, self.crf = Path(path), fps, crf
        self._stream: Any = None

    def __enter__(self) -> VideoWriter:
        import av

        self._container = av.open(str(self.path), "w")
        return self

    def add(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        height, width = (n - n % 2 for n in image.shape[:2])
        if self._stream is None:
            rate = Fraction(self.fps).limit_denominator(1000)
            self._stream = self._container.add_stream("libx264", rate=rate)
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = "yuv420p"
            self._stream.options = {"crf": str(self.crf), "preset": "veryfast"}
            declare_colors(self._stream)
        frame = coded(np.ascontiguousarray(image[:height, :width]), self._stream)
        self._container.mux(self._stream.encode(frame))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._stream is not None and kind is None:
            self._container.mux(self._stream.encode())
        self._container.close()
