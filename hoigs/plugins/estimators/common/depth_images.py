"""Depth in image files: 16-bit PNG and EXR."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from hoigs.core.errors import HoigsError
from hoigs.core.files.regular_file import regular_file
from hoigs.plugins.estimators.common.frame_files import FileDiagnostics


def read_png16(path: Path) -> Int[np.ndarray, "H W"]:
    """Whole numbers of a 16-bit grey PNG.

    Raises:
        HoigsError: 8 bits or colours, which are pictures of depth, not depth.
    """
    try:
        with Image.open(regular_file(path)) as image:
            if not image.mode.startswith("I"):
                raise HoigsError(
                    f"{path} is an 8-bit or coloured image ({image.mode}): a picture of depth, "
                    "from which it cannot be had back; write 16-bit PNG, .npy or .npz"
                )
            return np.asarray(image).astype(np.int64)
    except OSError as error:
        raise HoigsError(f"{path} is no readable image: {error}") from error


def exr_size(path: Path, problems: FileDiagnostics) -> tuple[int, int] | None:
    """Width and height of an EXR file; adds to `problems` when it cannot be read."""
    try:
        array = read_exr(path)
    except HoigsError as error:
        problems.add(str(error))
        return None
    return array.shape[1], array.shape[0]


def read_exr(path: Path) -> Float[np.ndarray, "H W"]:
    """The one channel of an EXR file, or the first of three equal ones (by ffmpeg's decoder).

    Raises:
        HoigsError: unreadable, or channels that differ, which is no depth.
    """
    import av

    try:
        with av.open(str(regular_file(path))) as container:
            frame = next(container.decode(video=0))
    except (OSError, av.error.FFmpegError, StopIteration, IndexError, ValueError) as error:
        raise HoigsError(
            f"{path} is no EXR file that ffmpeg decodes ({error}); write .npy or .npz instead"
        ) from error
    if not frame.format.name.endswith("f32le"):
        frame = frame.reformat(format="gbrpf32le")
    planes = [
        np.frombuffer(bytes(plane), np.float32).reshape(frame.height, -1)[:, : frame.width]
        for plane in frame.planes[:3]
    ]
    if any(not np.array_equal(planes[0], plane, equal_nan=True) for plane in planes[1:]):
        raise HoigsError(f"{path}: its channels differ, so it is a picture, not depth")
    return planes[0]
