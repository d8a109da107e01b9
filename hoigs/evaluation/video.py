"""Frames to an mp4."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8


def write_video(
    path: Path | str, frames: Iterable[UInt8[np.ndarray, "H W 3"]], *, fps: float = 30.0
) -> Path:
    """Encode RGB frames as H.264 (yuv420p, which every player shows), whole or not at all.

    Odd sizes lose their last row or column, as the format demands even ones.

    Raises:
        ValueError: there are no frames, or their sizes differ.
    """
    import av

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    count = 0
    try:
        with av.open(str(temporary), "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "18", "preset": "medium"}
            for count, frame in enumerate(frames, 1):
                frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
                if count == 1:
                    stream.height, stream.width = frame.shape[:2]
                elif frame.shape[:2] != (stream.height, stream.width):
                    raise ValueError(
                        f"frame {count - 1} is {frame.shape[1]}x{frame.shape[0]}, the first was "
                        f"{stream.width}x{stream.height}"
                    )
                image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                container.mux(stream.encode(image))
            if count == 0:
                raise ValueError("a video needs at least one frame")
            container.mux(stream.encode())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
