"""LazyFrames: pixels of a list of files, decoded on access, lens distortion removed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.system.files import regular_file
from hoigs.core.system.images import eight_bits, mask_values
from hoigs.core.system.npz import load_array, load_arrays
from hoigs.core.system.video_files import PixelCache
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, FrameStore
from hoigs.core.values.lens import Lens, Undistortion
from hoigs.core.values.moment import Moment

Array = np.ndarray
ASPECT_TOLERANCE = 0.02  # a mask of half an odd size has a slightly different aspect ratio


def bright(image: Image.Image) -> Array:
    """Foreground is brighter than half: masks of 0 and 255."""
    return mask_values(image) > 127


def dark(image: Image.Image) -> Array:
    """Foreground is darker than half: masks whose background is white."""
    return mask_values(image) < 128


@dataclass(frozen=True)
class MaskFiles:
    """One mask file for each frame.

    Attributes:
        paths: None where there is no file, which means an empty mask.
        foreground: a decoded mask image to bool [H, W]; palette images come with their indices.
    """

    paths: Sequence[Path | None]
    foreground: Callable[[Image.Image], Array] = bright


@dataclass(frozen=True)
class DepthFiles:
    """One depth file for each frame.

    Attributes:
        paths: None where a frame has no depth.
        scale: factor from the file's values to world units: 0.001 for millimetres.
        read: a file to an array [H, W] before `scale`; NaN and infinity mean unknown, as 0 does.
    """

    paths: Sequence[Path | None]
    scale: float = 1.0
    read: Callable[[Path], Array] | None = None


@dataclass(frozen=True)
class PixelFiles:
    """The files of a clip's frames.

    Attributes:
        images: one for each frame. masks: by entity. ignored: pixels that show no scene.
        depth: in world units.
        background: RGB, 0..255, behind images with an alpha channel.
        read_image: a file to uint8 [H, W, 3], for frames that are not image files.
    """

    images: Sequence[Path]
    masks: Mapping[str, MaskFiles] | None = None
    ignored: MaskFiles | None = None
    depth: DepthFiles | None = None
    background: tuple[int, int, int] = (0, 0, 0)
    read_image: Callable[[Path], Array] | None = None


class LazyFrames(FrameStore):
    """Frames of a dataset, one file for each image, mask and depth map.

    Images must have the size of their lens (or camera); masks and depth maps of another size but
    the same aspect ratio are resampled by the nearest pixel. Images, masks and depth of a lens with
    distortion are undistorted alike, and pixels outside its view are `ignored`. Safe
    to read from several threads.

    Args:
        root: the folder of the data.
        cameras: the pinhole cameras of the frames.
        lenses: one for each frame; None, or a None among them, for a pinhole image.
        cache_mb: decoded pixels kept in memory, MiB; the least recently used go first.

    Raises:
        ClipError: a camera has numbers that are not finite.
    """

    root: Path

    def __init__(
        self,
        root: Path,
        files: PixelFiles,
        cameras: Sequence[Camera],
        *,
        lenses: Sequence[Lens | None] | None = None,
        cache_mb: int = 512,
    ) -> None:
        self.root, self.images, self.cameras = Path(root), list(files.images), list(cameras)
        ignored, depth = files.ignored, files.depth
        self.masks, self.ignored_files, self.depth_files = dict(files.masks or {}), ignored, depth
        self.lenses = list(lenses) if lenses is not None else [None] * len(self.images)
        self.background, self.cache = files.background, PixelCache(cache_mb)
        self._read_image = files.read_image or self._decode
        counts = {len(self.images), len(self.cameras), len(self.lenses)}
        of_frames = [*self.masks.values(), ignored, depth]
        counts |= {len(each.paths) for each in of_frames if each is not None}
        if len(counts) != 1:
            raise ValueError(
                f"lists of different lengths: {sorted(counts)}; expected one entry for each frame"
            )
        for path, camera in zip(self.images, self.cameras, strict=True):
            if not (camera.K.isfinite().all() and camera.world_to_camera.isfinite().all()):
                raise ClipError(f"{path}: its camera has numbers that are not finite")

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        def load() -> Tensor:
            path = self.images[position]
            pixels = self._read_image(path)
            self._check_size(path, pixels, position)
            flat = torch.from_numpy(self._flat(position).image(pixels))
            # copied after the temporaries are freed: a frame allocated behind them would otherwise
            # keep their memory from being returned, ten times its own
            return flat.clone(memory_format=torch.contiguous_format)

        return self.cache.get(("image", position), load)

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        return self.cache.get(
            (entity, position), lambda: self._mask(self.masks[entity], position)
        )  # fmt: skip

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        if self.depth_files is None or self.depth_files.paths[position] is None:
            return None
        return self.cache.get(("depth", position), lambda: self._depth(position))

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        marked = self.cache.get(("ignored", position), lambda: self._ignored(position))
        return marked if marked.numel() else None

    def _ignored(self, position: int) -> Tensor:
        """An empty tensor where nothing is ignored, so that the cache holds this too."""
        files, outside = self.ignored_files, self._flat(position).outside
        beyond = torch.zeros(0, dtype=torch.bool) if outside is None else torch.from_numpy(outside)
        if files is None or files.paths[position] is None:
            return beyond
        marked = self._mask(files, position)
        return marked | beyond if beyond.numel() else marked

    def _mask(self, files: MaskFiles, position: int) -> Tensor:
        path, camera = files.paths[position], self.cameras[position]
        if path is None:
            return torch.zeros(camera.height, camera.width, dtype=torch.bool)
        with opened(path) as image, _named(path):
            marked = np.asarray(files.foreground(image), dtype=np.bool_)
        return torch.from_numpy(self._flat(position).mask(self._fitted(path, marked, position)))

    def _depth(self, position: int) -> Tensor:
        assert self.depth_files is not None
        path = self.depth_files.paths[position]
        assert path is not None
        read = self.depth_files.read or read_depth
        values = np.asarray(read(path), dtype=np.float32) * np.float32(self.depth_files.scale)
        values = np.where(np.isfinite(values) & (values > 0), values, np.float32(0))
        return torch.from_numpy(self._flat(position).depth(self._fitted(path, values, position)))

    def _decode(self, path: Path) -> UInt8[Array, "H W 3"]:
        with opened(path) as image, _named(path):
            if image.mode not in ("RGBA", "LA", "PA") and "transparency" not in image.info:
                return np.array(eight_bits(image).convert("RGB"))
            pixels = np.asarray(image.convert("RGBA"), dtype=np.float32)
        alpha = pixels[..., 3:] / 255
        mixed = pixels[..., :3] * alpha + np.array(self.background, np.float32) * (1 - alpha)
        return mixed.round().astype(np.uint8)

    def _flat(self, position: int) -> Undistortion:
        lens = self.lenses[position]
        return Undistortion() if lens is None else lens.undistortion()

    def _check_size(self, path: Path, pixels: Array, position: int) -> None:
        camera = self.cameras[position]
        if pixels.shape[:2] != (camera.height, camera.width):
            raise ClipError(
                f"{path} is {pixels.shape[1]}x{pixels.shape[0]}, its camera "
                f"{camera.width}x{camera.height}: image and intrinsics must be of one size"
            )

    def _fitted(self, path: Path, values: Array, position: int) -> Array:
        """At the frame's size, by the nearest pixel."""
        camera = self.cameras[position]
        height, width = values.shape[:2]
        if (width, height) == (camera.width, camera.height):
            return values
        if not values.size or (
            abs(width * camera.height / (height * camera.width) - 1) > ASPECT_TOLERANCE
        ):
            raise ClipError(
                f"{path} is {width}x{height}, the frame {camera.width}x{camera.height}: "
                "different aspect ratios"
            )
        rows = ((np.arange(camera.height) + 0.5) * height / camera.height).astype(int)
        columns = ((np.arange(camera.width) + 0.5) * width / camera.width).astype(int)
        return values[rows[:, None], columns]


def opened(path: Path) -> Image.Image:
    """A decoded image.

    Raises:
        ClipError: it cannot be read; the message names the file.
    """
    try:
        image = Image.open(regular_file(path))
        image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ClipError(f"{path} cannot be decoded ({error}); write it again") from error
    return image


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Values that are no picture's, with the name of their file."""
    try:
        yield
    except ValueError as error:
        raise ClipError(f"{path}: {error}") from error


def image_size(path: Path) -> tuple[int, int]:
    """Width and height from the file's header.

    Raises:
        ClipError: not a readable image.
    """
    try:
        with Image.open(regular_file(path)) as image:
            return image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ClipError(f"{path} is not a readable image ({error})") from error


def lens_for(lens: Lens, image: Path) -> Lens:
    """The lens at the size that an image file has: data sets have images_2 and the like.

    Raises:
        ClipError: the image and the lens have different aspect ratios, or cannot be read.
    """
    width, height = image_size(image)
    if min(lens.width, lens.height) < 1:
        size = f"{lens.width}x{lens.height}"
        raise ClipError(f"the camera of {image} is {size} pixels; correct its size")
    if abs(width * lens.height / (height * lens.width) - 1) > ASPECT_TOLERANCE:
        raise ClipError(
            f"{image} is {width}x{height}, its camera {lens.width}x{lens.height}: different "
            "aspect ratios"
        )
    return lens.resized(width, height)


def read_depth(path: Path) -> Array:
    """A depth map [H, W] of a `.npy`, a `.npz` with "depth", or a grey image of 8, 16 or 32 bits.

    Raises:
        ClipError: it cannot be read, or has more than one channel.
    """
    try:
        if path.suffix == ".npy":
            values = load_array(path)
        elif path.suffix == ".npz":
            values = load_arrays(path)["depth"]
        else:
            values = np.asarray(opened(path))
    except (OSError, ValueError, KeyError) as error:
        raise ClipError(f"{path} cannot be read as depth ({error}); write it again") from error
    values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    if values.ndim != 2:
        raise ClipError(f"{path} has shape {list(values.shape)}, expected depth [H, W]")
    return values


# The order of frames, and when each was taken.

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def natural(name: str) -> list[tuple[int, int, str]]:
    """A sort key with which frame_9 comes before frame_10."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts if p]


def image_files(folder: Path) -> list[Path]:
    """The images of a folder, in natural order of their names."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]
    return sorted(found, key=lambda p: natural(p.name))


def video_moments(
    indices: Sequence[int], count: int, bodies: Mapping[str, BodyTrack] | None = None
) -> list[Moment]:
    """Moments of a video's frames, evenly spaced in time.

    Args:
        indices: frame numbers among the video's, which may leave some out.
        count: frames of the whole video, so that frames that were left out still take their time.
        bodies: tracks with one pose for each of `indices`.
    """
    last = max(count - 1, 1)
    return [
        Moment(index / last, index, {n: t.poses.frame(i) for n, t in (bodies or {}).items()})
        for i, index in enumerate(indices)
    ]


def timed_moments(times: Sequence[float], train: Sequence[int]) -> list[Moment]:
    """Moments at given times, numbered on the even grid that the training times span.

    Args:
        times: frame times, in any unit from 0; scaled to [0, 1] by the largest if it exceeds 1
            (4DGaussians, scene/dataset_readers.py: read_timeline).
        train: positions of the training frames; their different times are the clip's frames.
    """
    longest = max(times)
    scaled = [t / longest if longest > 1 else t for t in times]
    steps = max(len({scaled[i] for i in train}) - 1, 1)
    return [Moment(t, round(t * steps)) for t in scaled]
