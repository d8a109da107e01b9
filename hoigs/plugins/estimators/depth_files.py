"""estimator:depth-files: depth that any estimator has written: .npy, .npz, 16-bit PNG, EXR.

Numbers alone do not show whether they are metres or disparity, and a wrong guess turns the scene
inside out. So the settings or the file itself must declare it; otherwise the depth is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float, Int
from PIL import Image
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    DepthKind,
    DepthMaps,
    Estimates,
    Estimator,
    LazyFrames,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.files import regular_file
from hoigs.core.system.video_files import pyav
from hoigs.plugins.estimators.frame_files import (
    FileDiagnostics,
    absent,
    image_size,
    load_array,
    npz_shapes,
    numbered,
    require_count,
    require_frames,
    require_sizes,
    resized,
    unpacked,
    wrong_size,
)

# Depth in image files: 16-bit PNG and EXR.


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
    av = pyav()

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


SUFFIXES = (".npy", ".npz", ".png", ".exr")
# names of arrays that declare the kind; "depth" does not: Metric3D and DepthCrafter both write it
KINDS_BY_NAME: dict[str, DepthKind] = {
    "disparity": "disparity", "disparities": "disparity", "inverse_depth": "disparity",
    "metric_depth": "metric", "depth_metric": "metric", "depth_m": "metric",
}  # fmt: skip
MADE_BY = (
    "Depth comes from your estimator, one map a frame of the video, named by its number, or one "
    "[frames, height, width] array: Metric3D, UniDepth and the metric models of Depth Anything "
    "write `kind: metric`; Depth Anything V2, Video Depth Anything and DepthCrafter otherwise "
    "write `kind: disparity`."
)


class DepthFilesConfig(ComponentConfig):
    """Settings of `estimator:depth-files`."""

    path: Path = Field(
        default=Path("depth"),
        description="a folder of .npy, .npz, .png (16-bit) or .exr files, or one .npy or .npz "
        "file; relative to the video's folder",
    )
    kind: DepthKind | None = Field(
        default=None,
        description="'metric': metres along the axis, after `scale`; 'disparity': more is nearer; "
        "None: an .npz file declares it by an array's name, or by an array `kind`",
    )
    scale: float | None = Field(
        default=None, gt=0, description="metres a unit; needed for metric PNGs (0.001 for mm)"
    )
    key: str | None = Field(default=None, description="array of an .npz file; None: its only one")
    invalid: float | None = Field(
        default=None, description="value, before `scale`, that means unknown; beside NaN and, for "
        "metric depth, all that is not positive"
    )  # fmt: skip
    first_frame: int | None = Field(
        default=None, description="number of frame 0's file; None: 0, or 1 if they count from 1"
    )
    resize: bool = Field(default=False, description="resize maps of other sizes than the video's")


class DepthFilesEstimator(Estimator):
    """Depth maps from files."""

    Config: ClassVar = DepthFilesConfig
    config: DepthFilesConfig
    provides = frozenset({"depth"})

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        path = video.resolve(self.config.path)
        problems = FileDiagnostics("estimator:depth-files", MADE_BY)
        declared: set[DepthKind] = set()
        read: Callable[[int], np.ndarray] | None = None
        if not path.exists():
            problems.add(absent(path))
        elif path.is_dir():
            read = self._folder(path, video, problems, declared)
        else:
            read = self._file(path, video, problems, declared)
        kind = self._kind_of(declared, path, problems)
        problems.raise_if_any()
        assert read is not None and kind is not None

        def depth(i: int) -> Float[np.ndarray, "H W"]:
            return self._cleaned(read(i), kind, video)

        progress(1.0, "depth")
        maps = LazyFrames(video.frames, depth)
        return Estimates(depth=DepthMaps(maps, kind, f"files of {path.name}, {kind}"))

    def _kind_of(
        self, declared: set[DepthKind], path: Path, problems: FileDiagnostics
    ) -> Literal["metric", "disparity"] | None:
        if self.config.kind is not None:
            if declared and declared != {self.config.kind}:
                problems.add(
                    f"{path} declares that it holds {declared.pop()}, but `kind` is "
                    f"{self.config.kind}"
                )
            return self.config.kind
        if len(declared) == 1:
            return next(iter(declared))
        problems.add(
            f"{path} does not declare whether it holds metres or disparity, and numbers alone do "
            "not show it: set `kind: metric` or `kind: disparity`"
        )
        return None

    def _folder(
        self, folder: Path, video: VideoRequest, problems: FileDiagnostics, declared: set[DepthKind]
    ) -> Callable[[int], np.ndarray]:
        files = numbered(folder, SUFFIXES, video, problems, self.config.first_frame)
        if files:
            require_frames(files, folder, video, problems)
        sizes, keys = {}, {}
        for i in video.numbers:
            if i in files:
                size, key = self._header(files[i], problems, declared)
                if size:
                    sizes[files[i]] = size
                keys[files[i]] = key
        require_sizes(sizes, video, self.config.resize, problems)
        whole_numbers = any(p.suffix.lower() == ".png" for p in sizes)
        if whole_numbers and self.config.scale is None and self.config.kind != "disparity":
            problems.add(
                f"{folder}: PNGs hold whole numbers; set `scale`, the metres that 1 stands for "
                "(0.001 if they are millimetres)"
            )

        def read(i: int) -> np.ndarray:
            if i not in files:
                raise HoigsError(f"{folder} has no depth of frame {i}")
            return _read(files[i], keys.get(files[i]))

        return read

    def _file(
        self, path: Path, video: VideoRequest, problems: FileDiagnostics, declared: set[DepthKind]
    ) -> Callable[[int], np.ndarray] | None:
        """One array for all frames."""
        suffix = path.suffix.lower()
        if suffix == ".npy":
            array = load_array(path, problems)
            shape, key = (None if array is None else array.shape), None
        elif suffix == ".npz":
            array = None
            shape, key = self._choose(path, problems, declared)
        else:
            problems.add(f"{path}: expected a folder, or an .npy or .npz file of all frames")
            return None
        if shape is None:
            return None
        if len(shape) != 3:
            problems.add(f"{path}: an array of shape {shape}, expected [frames, height, width]")
            return None
        require_count(shape[0], path, video, problems)
        if why := wrong_size((shape[2], shape[1]), video, self.config.resize):
            problems.add(f"{path}: {why}")
        values: list[np.ndarray] = [] if array is None else [array]

        def read(i: int) -> np.ndarray:
            if not values:
                values.append(unpacked(path, str(key), video.work))
            return np.asarray(values[0][i])

        return read

    def _choose(
        self, path: Path, problems: FileDiagnostics, declared: set[DepthKind]
    ) -> tuple[tuple[int, ...] | None, str | None]:
        """Shape and name of the array of an .npz file that holds depth; adds the declared kind."""
        shapes = npz_shapes(path, problems)
        maps = [k for k, (shape, dtype) in shapes.items() if len(shape) > 1 and dtype.kind in "fiu"]
        key = self.config.key or (maps[0] if len(maps) == 1 else None)
        if key not in shapes:
            if shapes:
                problems.add(
                    f"{path} holds {', '.join(shapes)}; name the array of depth with `key`"
                )
            return None, None
        if key.lower() in KINDS_BY_NAME:
            declared.add(KINDS_BY_NAME[key.lower()])
        if "kind" in shapes:
            with np.load(path, allow_pickle=False) as file:
                text = str(file["kind"])
            if text == "metric":
                declared.add("metric")
            elif text == "disparity":
                declared.add("disparity")
            else:
                problems.add(f'{path}: its `kind` is "{text}", expected metric or disparity')
        return shapes[key][0], key

    def _header(
        self, path: Path, problems: FileDiagnostics, declared: set[DepthKind]
    ) -> tuple[tuple[int, int] | None, str | None]:
        """Width and height of one frame's file, and its array's name if it has several."""
        suffix = path.suffix.lower()
        if suffix == ".exr":
            return exr_size(path, problems), None
        if suffix == ".png":
            return image_size(path, problems), None
        key = None
        if suffix == ".npy":
            array = load_array(path, problems)
            shape = None if array is None else array.shape
        else:
            shape, key = self._choose(path, problems, declared)
        if shape is None:
            return None, key
        plain = _plain(shape)
        if len(plain) != 2:
            problems.add(f"{path}: an array of shape {shape}, expected [height, width]")
            return None, key
        return (plain[1], plain[0]), key

    def _cleaned(
        self, values: np.ndarray, kind: DepthKind, video: VideoRequest
    ) -> Float[np.ndarray, "H W"]:
        """float32 at the video's size; NaN where depth is not known."""
        depth = values.astype(np.float32)
        unknown = ~np.isfinite(depth)
        if self.config.invalid is not None:
            unknown |= depth == self.config.invalid
        if kind == "metric":
            unknown |= depth <= 0
        depth = np.where(unknown, np.float32(np.nan), depth * np.float32(self.config.scale or 1.0))
        # bilinear would spread NaN, and mix what is near with what is far, along edges
        return resized(depth, (video.width, video.height), smooth=False).astype(np.float32)


def _plain(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Without leading and trailing axes of one."""
    while len(shape) > 2 and shape[0] == 1:
        shape = shape[1:]
    while len(shape) > 2 and shape[-1] == 1:
        shape = shape[:-1]
    return shape


def _read(path: Path, key: str | None) -> np.ndarray:
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr(path)
    if suffix == ".png":
        return read_png16(path)
    if suffix == ".npy":
        array = np.load(path, allow_pickle=False)
    else:
        with np.load(path, allow_pickle=False) as file:
            array = file[str(key)]
    return array.reshape(_plain(array.shape))
