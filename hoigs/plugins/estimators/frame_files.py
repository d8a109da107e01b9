"""Files of estimators: the frame that each belongs to, what is absent, what does not fit."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.estimator import VideoRequest
from hoigs.core.system.files import regular_file
from hoigs.core.system.npz import plain_reason

_NUMBER = re.compile(r"\d+")
SHOWN = 8  # frames or files named in a message; the rest are counted


class FileDiagnostics:
    """What is wrong with a set of files, gathered so that one error lists everything.

    Args:
        estimator: key of the reader. made_by: who makes such files, and how they should be.
    """

    def __init__(self, estimator: str, made_by: str) -> None:
        self.estimator, self.made_by = estimator, made_by
        self.lines: list[str] = []

    def add(self, line: str) -> None:
        self.lines.append(line)

    def raise_if_any(self) -> None:
        """Raise HoigsError with everything that was added."""
        if self.lines:
            lines = "\n".join(f"  - {line}" for line in self.lines)
            raise HoigsError(f"{self.estimator} cannot be used:\n{lines}\n{self.made_by}")


def listed(items: Iterable[object], shown: int = SHOWN) -> str:
    """The first few, comma-separated, and how many more."""
    texts = [str(item) for item in items]
    more = f" and {len(texts) - shown} more" if len(texts) > shown else ""
    return ", ".join(texts[:shown]) + more


def absent(path: Path) -> str:
    """That `path` is not there, with the nearest name that is."""
    there = [p.name for p in path.parent.glob("*")] if path.parent.is_dir() else []
    return f"{path}: no such file or folder{did_you_mean(path.name, there)}"


def numbered(
    folder: Path,
    suffixes: Sequence[str],
    video: VideoRequest,
    problems: FileDiagnostics,
    first_frame: int | None = None,
) -> dict[int, Path]:
    """Frame of the video to the file that is named after it.

    The number is the last one in the name: 00017.png, frame_17.png, clip_000017_mask.png. Some
    tools count from 1 (ffmpeg, COLMAP's examples): so do files that go from 1 to the number of
    frames. `first_frame`, the number of the file of frame 0, overrides this.

    Files that cannot be placed, and wanted frames that have none, are added to `problems`.
    """
    if not folder.is_dir():
        problems.add(absent(folder) if not folder.exists() else f"{folder} is not a folder")
        return {}
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes)
    if not paths:
        problems.add(f"{folder} holds no {' or '.join(suffixes)} files")
        return {}
    by_number: dict[int, list[Path]] = {}
    for path in paths:
        numbers = _NUMBER.findall(path.stem)
        if not numbers:
            problems.add(f"{path.name} in {folder} has no frame number in its name")
            return {}
        by_number.setdefault(int(numbers[-1]), []).append(path)
    double = {n: p for n, p in by_number.items() if len(p) > 1}
    if double:
        n, pair = next(iter(double.items()))
        problems.add(
            f"{folder} holds {len(double)} frames twice, such as frame {n}: "
            f"{listed(p.name for p in pair)}; one folder an entity or kind"
        )
        return {}
    if first_frame is None:
        first_frame = 1 if 0 not in by_number and max(by_number) == video.frames else 0
    files = {n - first_frame: p[0] for n, p in by_number.items()}
    outside = sorted(p.name for i, p in files.items() if not 0 <= i < video.frames)
    if outside:
        problems.add(
            f"{folder}: {listed(outside)} belong to no frame of the video, which has "
            f"{video.frames}; if the first file is not number {first_frame}, set `first_frame`"
        )
    return {i: p for i, p in files.items() if 0 <= i < video.frames}


def require_frames(
    files: dict[int, Path], where: object, video: VideoRequest, problems: FileDiagnostics
) -> None:
    """Add to `problems` the wanted frames that have no file."""
    lacking = [i for i in video.numbers if i not in files]
    if lacking:
        problems.add(
            f"{where} lacks {len(lacking)} of {len(video.numbers)} frames: {listed(lacking)}"
        )


def require_count(
    count: int, where: object, video: VideoRequest, problems: FileDiagnostics
) -> None:
    """Add to `problems` that an array has another number of frames than the video."""
    if count != video.frames:
        problems.add(
            f"{where} has {count} frames, the video has {video.frames}; turn off "
            "frame skipping and length limits of the tool that wrote it"
        )


def wrong_size(size: tuple[int, int], video: VideoRequest, resize: bool) -> str | None:
    """Why an image of `size` (width, height) does not fit the video, or None.

    With `resize` any size fits whose proportions differ by less than a tenth: networks round their
    sizes to multiples of 14 or 64.
    """
    width, height = size
    if size == (video.width, video.height):
        return None
    text = f"{width}x{height}, the video is {video.width}x{video.height}"
    if not resize:
        return f"{text} (`resize: true` enlarges or shrinks)"
    stretch = (width * video.height) / (height * video.width)
    return None if 1 / 1.1 < stretch < 1.1 else f"{text}: the proportions differ"


def require_sizes(
    sizes: dict[Path, tuple[int, int]], video: VideoRequest, resize: bool, problems: FileDiagnostics
) -> None:
    """Add to `problems` the files that do not fit the video's size."""
    wrong = {p: why for p, size in sizes.items() if (why := wrong_size(size, video, resize))}
    if wrong:
        path, why = next(iter(wrong.items()))
        count = f" and {len(wrong) - 1} more files" if len(wrong) > 1 else ""
        problems.add(f"{path}{count}: {why}")


def image_size(path: Path, problems: FileDiagnostics) -> tuple[int, int] | None:
    """Width and height from an image's header; adds to `problems` when it has none."""
    from PIL import Image

    try:
        with Image.open(regular_file(path)) as image:
            return image.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        problems.add(f"{path} is no readable image: {error}")
        return None


def load_array(path: Path, problems: FileDiagnostics) -> np.ndarray | None:
    """A .npy file, mapped, not read; adds to `problems` when it is damaged. No pickles."""
    try:
        return np.load(regular_file(path), mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        problems.add(f"{path} is no readable .npy file: {plain_reason(error)}")
        return None


def npz_shapes(
    path: Path, problems: FileDiagnostics
) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Shape and type of each array of an .npz file, from their headers."""
    found = {}
    try:
        with zipfile.ZipFile(regular_file(path)) as archive:
            for name in archive.namelist():
                with archive.open(name) as stream:
                    shape, _, dtype = _read_header(stream)
                found[name.removesuffix(".npy")] = (shape, dtype)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        problems.add(f"{path} is no readable .npz file: {error}")
    return found


def unpacked(path: Path, key: str, work: Path) -> np.ndarray:
    """One array of an .npz file, mapped from disk, so that a long video's fits in memory.

    A compressed array is written out once, to a file in `work`, frame by frame.
    """
    state = path.stat()
    target = work / "unpacked" / f"{path.stem}-{key}-{state.st_size}-{state.st_mtime_ns}.npy"
    if not target.is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        half = target.with_suffix(".part")
        with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as stream:
            shape, fortran, dtype = _read_header(stream)
            if fortran or dtype.hasobject:
                raise HoigsError(f"{path}, {key}: save it as a plain, C-ordered array of numbers")
            with half.open("wb") as out:
                np.lib.format.write_array_header_2_0(
                    out,
                    {
                        "descr": np.lib.format.dtype_to_descr(dtype),
                        "fortran_order": False,
                        "shape": shape,
                    },
                )
                while block := stream.read(1 << 22):
                    out.write(block)
        half.replace(target)
    return np.load(target, mmap_mode="r", allow_pickle=False)


def _read_header(stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"unknown .npy version {version}")
    return read(stream)


def resized(array: np.ndarray, size: tuple[int, int], *, smooth: bool) -> np.ndarray:
    """A [H, W] float array at another (width, height); bilinear, or the nearest pixel."""
    from PIL import Image

    if array.shape == size[::-1]:
        return array
    how = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(array.astype(np.float32)).resize(size, how))
