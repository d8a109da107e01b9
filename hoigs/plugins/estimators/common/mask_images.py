"""One mask file to pixels: palettes, greys, label images, videos."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int
from PIL import Image

from hoigs.core.errors import HoigsError
from hoigs.core.files.images import mask_values
from hoigs.core.files.npz import load_array
from hoigs.core.files.regular_file import regular_file
from hoigs.plugins.estimators.common.frame_files import FileDiagnostics

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
LOSSY = (".jpg", ".jpeg", ".webp")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
Inside = Literal["auto", "bright", "nonzero", "dark"]


class PackedMasks:
    """Masks at eight pixels a byte: a video cannot be read at random, so all of it is kept."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []
        self._width = 0

    def append(self, mask: Bool[np.ndarray, "H W"]) -> None:
        self._width = mask.shape[1]
        self._rows.append(np.packbits(mask, axis=1))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, i: int) -> Bool[np.ndarray, "H W"]:
        return np.unpackbits(self._rows[i], axis=1, count=self._width).astype(bool)


def read_mask(path: Path, inside: Inside) -> Bool[np.ndarray, "H W"]:
    """Pixels within the mask of an image or a .npy file.

    Raises:
        HoigsError: unreadable, or grey with only dark values, which may be a mask of 0 and 1 or
            an image of labels.
    """
    if path.suffix.lower() == ".npy":
        values = _npy(path)
        counts = values.dtype == bool or values.max(initial=0) <= 1
    else:
        with _open(path) as image:
            counts = image.mode in ("P", "1")
            try:
                values = np.asarray(image) if counts else mask_values(image)
            except ValueError as error:
                raise HoigsError(f"{path}: {error}") from error
    if inside == "dark":
        return values < 128
    if inside == "nonzero" or (inside == "auto" and counts):
        return values != 0
    bright = values > 127
    # compression leaves dark specks in an empty mask; exact formats do not
    if inside == "auto" and path.suffix.lower() not in LOSSY and values.any() and not bright.any():
        raise HoigsError(
            f"{path} holds values up to {int(values.max())} of 255: set `inside: nonzero` if all "
            "but 0 belongs to the mask, `holds: labels` if they are numbers of entities, `inside: "
            "bright` if it is empty"
        )
    return bright


def _npy(path: Path) -> np.ndarray:
    try:
        return load_array(path)
    except (OSError, ValueError) as error:
        raise HoigsError(f"{path} cannot be read ({error}); write it again") from error


def read_labels(path: Path) -> Int[np.ndarray, "H W"]:
    """Numbers of entities in a label image: palette indices (DAVIS), grey values (HOLD), or the
    colours of the palette that PASCAL VOC, DAVIS and SAM 2 share.

    Raises:
        HoigsError: unreadable, of a format that loses values, or of colours from elsewhere.
    """
    if path.suffix.lower() == ".npy":
        return _npy(path).astype(np.int64)
    if path.suffix.lower() in LOSSY:
        raise HoigsError(f"{path}: compression blurs labels; they come as .png or .npy")
    with _open(path) as image:
        if image.mode in ("RGB", "RGBA"):
            return _labels_of_colours(np.asarray(image.convert("RGB")), path)
        return np.asarray(image).astype(np.int64)


def voc_palette(count: int = 256) -> Int[np.ndarray, "N 3"]:
    """RGB of each label: bit 3k + c of the label is bit 7 - k of channel c."""
    labels = np.arange(count)
    colours = np.zeros((count, 3), np.int64)
    for k in range(8):
        for c in range(3):
            colours[:, c] |= (labels >> (3 * k + c) & 1) << (7 - k)
    return colours


def _labels_of_colours(rgb: np.ndarray, path: Path) -> Int[np.ndarray, "H W"]:
    code = np.array([1 << 16, 1 << 8, 1])
    known = {int(colour @ code): label for label, colour in enumerate(voc_palette())}
    codes = rgb.astype(np.int64) @ code
    there, back = np.unique(codes, return_inverse=True)
    strange = [f"#{c:06x}" for c in there.tolist() if c not in known]
    if strange:
        raise HoigsError(
            f"{path}: {', '.join(strange[:4])} are not colours of the DAVIS palette; save labels "
            "as palette indices or grey values"
        )
    return np.array([known[c] for c in there.tolist()])[back].reshape(codes.shape)


def read_video_masks(path: Path, inside: Inside, problems: FileDiagnostics) -> PackedMasks:
    """The masks of a black and white video; it must be bright inside, or dark."""
    import av

    stack = PackedMasks()
    try:
        with av.open(str(regular_file(path))) as container:
            for frame in container.decode(video=0):
                bright = frame.to_ndarray(format="gray") > 127
                stack.append(~bright if inside == "dark" else bright)
    except (OSError, av.error.FFmpegError, IndexError, ValueError) as error:
        problems.add(f"{path} is no readable video: {error}")
    return stack


def _open(path: Path) -> Image.Image:
    try:
        image = Image.open(regular_file(path))
        image.load()
    except (OSError, SyntaxError) as error:
        raise HoigsError(f"{path} is no readable image: {error}") from error
    return image
