"""Masks of people from the bits that `mediapipe_script.py` wrote."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt8
from PIL import Image

from hoigs.core.files.whole_files import written_whole
from hoigs.core.interfaces.estimator import LazyFrames, VideoRequest
from hoigs.plugins.estimators.common import steady_masks


def steadied(
    out: Path,
    person: UInt8[np.ndarray, "P N h B"],
    size: Int[np.ndarray, "2"],
    frames: Iterable[UInt8[np.ndarray, "H W 3"]],
    video: VideoRequest,
) -> tuple[UInt8[np.ndarray, "P N h B"], bool, Bool[np.ndarray, "P N"]]:
    """The bits of masks that agree where the camera stands still, whether it does, and which masks
    were changed for it.

    Args:
        out: file of what MediaPipe found; the result is kept beside it.
        size: width and height of the masks. frames: those of the masks, read only if needed.
    """
    scripts = (Path(steady_masks.__file__), Path(__file__))
    key = zlib.crc32(b"".join(path.read_bytes() for path in scripts))
    kept = out.with_name(f"{out.stem}-steady-{key:08x}.npz")
    if not kept.is_file():
        bits = person.copy()
        people = [_masks(rows, int(size[0])) for rows in person]
        steady = steady_masks.SteadyMasks(people, frames, (video.width, video.height))
        if steady.still:
            for k, i in np.ndindex(*bits.shape[:2]):
                bits[k, i] = np.packbits(steady.mask(k, i), axis=1)
        with written_whole(kept) as part, part.open("wb") as file:
            np.savez_compressed(file, person=bits, still=steady.still)
    with np.load(kept, allow_pickle=False) as file:
        bits = file["person"]
        return bits, bool(file["still"]), (bits != person).any((2, 3))


def frames_of(
    bits: UInt8[np.ndarray, "N h B"], size: Int[np.ndarray, "2"], first: int, video: VideoRequest
) -> LazyFrames:
    """Masks of the video's size from bits, whose first row is of frame `first`; empty ones of
    frames that were not looked at."""
    width, height = (video.width, video.height)

    def read(i: int) -> Bool[np.ndarray, "H W"]:
        if not 0 <= i - first < len(bits):
            return np.zeros((height, width), dtype=bool)
        mask = _mask(bits[i - first], int(size[0]))
        if mask.shape == (height, width):
            return mask
        large = Image.fromarray(mask.astype(np.uint8) * 255)
        return np.asarray(large.resize((width, height), Image.Resampling.BILINEAR)) > 127

    return LazyFrames(video.frames, read)


def _masks(bits: UInt8[np.ndarray, "N h B"], width: int) -> LazyFrames:
    return LazyFrames(len(bits), lambda i: _mask(bits[i], width))


def _mask(rows: UInt8[np.ndarray, "h B"], width: int) -> Bool[np.ndarray, "h w"]:
    return np.unpackbits(rows, axis=1, count=width).astype(bool)
