"""Which frames of a video become the clip, how wide they are stored, and what is said of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.container import missing_frames
from hoigs.preparation.video.frames import FrameList, Frames, open_frames
from hoigs.preparation.video.source import SourceError
from hoigs.preparation.video.span import Span

# Pixels that hold no picture: painted over, outside a stabilised frame, letterbox bars.
#
# They are not part of the scene, and they differ from frame to frame, so a static scene would
# otherwise be trained and scored on pixels that no camera saw.

BLACK = 2  # of 255: a lens and a codec never leave a real surface this dark and this flat
NEARLY_BLACK = 16  # the codec's ringing at the border of what was painted
SMALLEST = 5e-4  # of the image
MARGIN = 2  # pixels that the border mixes
PROBES = 5  # frames, one of which must show something


def blank_pixels(
    image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Flat black patches outside the masks of what moves (black shoes are no blank)."""
    darkness = image.max(-1)
    black = ndimage.binary_opening((darkness <= BLACK) & ~moving, iterations=1)
    labels, count = ndimage.label(black)
    if count == 0:
        return np.zeros_like(black)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    patches = (sizes >= max(16, SMALLEST * black.size))[labels]
    around = (darkness <= NEARLY_BLACK) & ~moving
    grown = ndimage.binary_propagation(patches, mask=around | patches)
    return ndimage.binary_dilation(grown, iterations=MARGIN) & ~moving if grown.any() else grown


def require_pictures(frames: Frames) -> None:
    """That a video shows something.

    Raises:
        SourceError: some frames from all over it are all black.
    """
    places = np.linspace(0, len(frames) - 1, min(PROBES, len(frames))).round().astype(int)
    brightest = 0
    for place in places.tolist():  # the first one settles it for nearly every video
        brightest = max(brightest, int(np.quantile(frames.read(frames.indices[place]), 0.99)))
        if brightest > NEARLY_BLACK:
            return
    raise SourceError(
        f"{frames.path} is black: in {len(places)} frames from all over it nothing is brighter "
        f"than {brightest} of 255"
    )


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
