"""The focal length that a video's container, or a photo's EXIF, gives."""

from __future__ import annotations

import math
from pathlib import Path

from hoigs.preparation.video.container import open_video
from hoigs.preparation.video.source import numbered_frames

# phones that give it give the equivalent on 35 mm film, whose picture is 43.27 mm across: Apple's
# QuickTime key, and EXIF's name for the same
SUFFIXES = ("focal_length.35mm_equivalent", "focallengthin35mmfilm", "focallengthin35mmformat")
DIAGONAL = math.hypot(36, 24)
EXIF_BLOCK, EXIF_FOCAL_35 = 0x8769, 0xA405


def focal_of_metadata(path: Path, width: int, height: int) -> tuple[float, str] | None:
    """Focal length in pixels of the source, and what gave it; None if nothing does.

    The equivalent is of the picture's diagonal. A video that is cropped out of the sensor's
    picture, for steadiness, has a longer one: 10 % are common.

    Args:
        path: of a video or a folder of images. width, height: of its frames.
    """
    found = _of_image(path) if path.is_dir() else _of_container(path)
    if found is None:
        return None
    film, name = found
    return film / DIAGONAL * math.hypot(width, height), f"{name}: {film:g} mm on 35 mm film"


def _of_container(path: Path) -> tuple[float, str] | None:
    container, _ = open_video(path)
    with container:
        entries = [container.metadata, *(stream.metadata for stream in container.streams)]
    for metadata in entries:
        for key, value in metadata.items():
            if key.lower().endswith(SUFFIXES) and (film := _positive(value)):
                return film, key
    return None


def _of_image(folder: Path) -> tuple[float, str] | None:
    from PIL import Image

    with Image.open(numbered_frames(folder)[0]) as image:
        value = image.getexif().get_ifd(EXIF_BLOCK).get(EXIF_FOCAL_35)
    film = _positive(value)
    return (film, "EXIF FocalLengthIn35mmFilm") if film else None


def _positive(value: object) -> float | None:
    """A number greater than 0, as files have it; None for 0, which means unknown, and for text."""
    try:
        number = float(str(value))
    except ValueError:
        return None
    return number if math.isfinite(number) and number > 0 else None
