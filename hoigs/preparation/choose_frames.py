"""Which frames of a video become the clip, how wide they are stored, and what is said of them."""

from __future__ import annotations

from pathlib import Path

from hoigs.preparation.options.prepare_options import PrepareOptions
from hoigs.preparation.video.blank import require_pictures
from hoigs.preparation.video.frames import FrameList, open_frames
from hoigs.preparation.video.header import missing_frames
from hoigs.preparation.video.source import SourceError
from hoigs.preparation.video.span import Span

LARGEST, REDUCED = 1920, 1280  # longer sides, pixels: of frames that are kept, and of smaller ones
FEWEST = 3  # motion is judged by accelerations


def choose_frames(path: Path, options: PrepareOptions) -> tuple[FrameList, list[str]]:
    """The chosen frames, and what is to be said of them.

    Args:
        path: a video, or a folder of images. options: how many, how dense and from when to when.

    Raises:
        SourceError: fewer than three are left, or they have nothing in them.
    """
    span = Span.of(options.start, options.end)
    frames = open_frames(
        path, options.width, options.every, options.max_frames, fps=options.fps,
        pick=options.pick, rate=options.folder_fps, span=span,
    )  # fmt: skip
    if len(frames) < FEWEST:
        raise SourceError(
            f"{path}: {len(frames)} of its frames would be used, as the options are; a "
            "clip shows motion, and needs three or more"
        )
    require_pictures(frames)
    notes = []
    if path.is_file() and span.end is None and options.max_frames is None:
        notes += missing_frames(path, frames.total)
    if frames.uneven:
        notes.append(
            f"the chosen frames are not evenly spaced (a variable frame rate, or the "
            f"sharpest of each few): the clip keeps their true times, {frames.fps:.4g} a "
            "second on average"
        )
    return frames.list, [*notes, *frames.notes]


def stored_width(found: FrameList) -> tuple[int | None, list[str]]:
    """The width of stored frames where none is given; smaller if they are larger than a clip needs.

    Returns:
        None for their own width; and what is to be said of it.
    """
    longest = max(found.native_width, found.native_height)
    if longest <= LARGEST:
        return None, []
    width = round(found.native_width * REDUCED / longest)
    return width, [
        f"frames of {found.native_width}x{found.native_height} are stored at a width of {width}"
        " (--width keeps more)"
    ]
