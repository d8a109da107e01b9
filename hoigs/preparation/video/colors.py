"""Decoded frames to 8-bit sRGB, by FFmpeg's own scale filter.

The filter knows every pixel format, matrix and range that FFmpeg decodes. Brightness curves of
displays (BT.709, BT.601, sRGB, BT.2020's 10 bits and the like) are shown as they are, as players
and FFmpeg do. HDR (HLG, PQ), linear and logarithmic light, and wide primaries (BT.2020, P3) look
grey when so shown: they are converted to sRGB, HDR by FFmpeg's tone mapping.
"""

from __future__ import annotations

import itertools
import threading
from functools import lru_cache
from typing import Any

from hoigs.preparation.video.source import SourceError

# numbers are those of ITU-T H.273
CONVERTED = {8: "linear light", 9: "logarithmic light", 10: "logarithmic light", 16: "PQ (HDR)",
             17: "SMPTE 428", 18: "HLG (HDR)"}  # fmt: skip
WIDE = {4: "BT.470 M", 8: "film", 9: "BT.2020", 10: "XYZ", 11: "DCI P3", 12: "Display P3"}
MATRICES = {8: "YCgCo", 10: "BT.2020 of constant luminance", 11: "SMPTE 2085",
            12: "derived from primaries", 13: "derived from primaries, of constant luminance",
            14: "ICtCp", 15: "IPT-C2 (Dolby Vision)", 16: "YCgCo-Re", 17: "YCgCo-Ro"}  # fmt: skip
GRAPHS = 12  # that are kept: a few sizes of one or two videos


def converted(frame: Any, width: int, height: int, form: str = "rgb24") -> Any:
    """A decoded frame (PyAV's) at a size in pixels, as `rgb24` or `gray`; grey is brightness as
    coded, to compare frames by.

    Raises:
        SourceError: its colours cannot be converted; it names their matrix, curve and primaries.
    """
    import av

    for tag in ("colorspace", "color_trc", "color_primaries"):  # reserved: nothing is known
        if int(getattr(frame, tag)) == 3 or (int(getattr(frame, tag)) == 0 and tag != "colorspace"):
            setattr(frame, tag, 2)
    curve, primaries = int(frame.color_trc), int(frame.color_primaries)
    try:
        if form == "rgb24" and (curve in CONVERTED or primaries in WIDE):
            # at the frame's own size: the table of the conversion takes seconds to make, once
            to_curve = "iec61966-2-1" if curve in CONVERTED else ""
            frame = _through(frame, frame.width, frame.height, "rgb48", to_curve)
        return _through(frame, width, height, form)
    except av.error.FFmpegError as error:
        raise SourceError(
            f"the video's colours cannot be converted ({_named(frame)}): {error}; convert it to "
            "BT.709 by the program that made it, or with `ffmpeg -i VIDEO -vf "
            "libplacebo=colorspace=bt709:color_primaries=bt709:color_trc=bt709 fixed.mp4`"
        ) from error


def _named(frame: Any) -> str:
    matrix, curve, primaries = (
        int(n) for n in (frame.colorspace, frame.color_trc, frame.color_primaries)
    )
    return (
        f"{frame.format.name}, matrix {MATRICES.get(matrix, matrix)}, curve "
        f"{CONVERTED.get(curve, curve)}, primaries {WIDE.get(primaries, primaries)}"
    )


def _through(frame: Any, width: int, height: int, form: str, to_curve: str | None = None) -> Any:
    shrinks = width < frame.width or height < frame.height
    options = f"w={width}:h={height}:flags={'area' if shrinks else 'bicubic'}"
    options += "+accurate_rnd+full_chroma_int"  # swscale is else up to 2 of 255 off
    if to_curve is not None:
        options += ":out_primaries=bt709" + (f":out_transfer={to_curve}" if to_curve else "")
    tags = tuple(int(n) for n in (frame.colorspace, frame.color_range))
    # the filter keeps what it made for a curve and primaries, and makes it anew when they change
    light = tuple(int(n) for n in (frame.color_trc, frame.color_primaries))
    size = (frame.width, frame.height)
    return _graph(frame.format.name, size, tags, light, options, form).run(frame)


class _Graph:
    """FFmpeg's filters from frames of one kind to another; threads take turns."""

    def __init__(self, chain: list[tuple[str, str]]) -> None:
        from av.filter import Graph

        self._lock, self._graph = threading.Lock(), Graph()
        nodes = [self._graph.add(name, options) for name, options in chain]
        for first, second in itertools.pairwise(nodes):
            first.link_to(second)
        self._graph.configure()

    def run(self, frame: Any) -> Any:
        with self._lock:
            self._graph.push(frame)
            return self._graph.pull()


@lru_cache(maxsize=GRAPHS)
def _graph(
    pixels: str,
    size: tuple[int, int],
    tags: tuple[int, int],
    light: tuple[int, int],
    options: str,
    form: str,
) -> _Graph:
    del light
    buffer = f"video_size={size[0]}x{size[1]}:pix_fmt={pixels}:time_base=1/1000"
    buffer += f":colorspace={tags[0]}:range={tags[1]}"
    return _Graph(
        [
            ("buffer", buffer),
            # HDR10+ gives each frame a curve of its own; a scene must not change from frame to
            # frame
            ("sidedata", "mode=delete:type=DYNAMIC_HDR_PLUS"),
            ("scale", options),
            ("format", form),
            ("buffersink", ""),
        ]
    )
