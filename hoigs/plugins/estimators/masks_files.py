"""estimator:masks-files: masks that any segmenter has written, in the layouts that are in use.

One folder an entity (DreamScene4D, BEHAVE, hoigs), label images with one number an entity (DAVIS,
HOLD, SAM 2's and Track Anything's scripts), or everything in one mask; as images, arrays or videos.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Int
from PIL import Image
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    Estimates,
    Estimator,
    LazyFrames,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.files import regular_file
from hoigs.core.system.images import mask_values
from hoigs.core.system.npz import load_array
from hoigs.core.system.video_files import pyav
from hoigs.plugins.estimators.frame_files import (
    FileDiagnostics,
    absent,
    image_size,
    npz_shapes,
    numbered,
    require_count,
    require_frames,
    require_sizes,
    unpacked,
    wrong_size,
)
from hoigs.plugins.estimators.frame_files import load_array as load_frames_array

# One mask file to pixels: palettes, greys, label images, videos.

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
    av = pyav()

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


Holds = Literal["entities", "labels", "together"]
MADE_BY = (
    "Masks come from your segmenter (SAM 2, SAMURAI, Track Anything, Mask R-CNN, …): one image a "
    "frame of the video, named by its number, at the video's size."
)


class MasksFilesConfig(ComponentConfig):
    """Settings of `estimator:masks-files`."""

    path: Path = Field(
        default=Path("masks"),
        description="a folder of images or .npy files, an .npz or .npy file, or a video; relative "
        "to the video's folder",
    )
    holds: Holds = Field(
        default="entities",
        description="'entities': one folder, file or npz array each; 'labels': images in which "
        "each entity has its number; 'together': one mask for all of them",
    )
    names: dict[str, int | str] = Field(
        default_factory=dict,
        description="entity to its folder, file or array ('entities'; its own name if left out), "
        "or to its number ('labels')",
    )
    inside: Inside = Field(
        default="auto",
        description="pixels within a mask: 'bright' above 127 of 255, 'nonzero', 'dark' below "
        "128, where white is the background; 'auto': nonzero for palettes, booleans and arrays "
        "of 0 and 1, else bright",
    )
    first_frame: int | None = Field(
        default=None, description="number of frame 0's file; None: 0, or 1 if they count from 1"
    )
    missing: Literal["refuse", "empty"] = Field(
        default="refuse", description="what a frame without a file means; 'empty': nothing is seen"
    )
    resize: bool = Field(default=False, description="resize masks of other sizes than the video's")


class MasksFilesEstimator(Estimator):
    """Masks from files."""

    Config: ClassVar = MasksFilesConfig
    config: MasksFilesConfig
    provides = frozenset({"masks"})

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        path = video.resolve(self.config.path)
        problems = FileDiagnostics("estimator:masks-files", MADE_BY)
        if not path.exists():
            problems.add(absent(path))
            problems.raise_if_any()
        if self.config.holds == "together":
            frames = self._masks(path, None, video, problems)
            problems.raise_if_any()
            return Estimates(EntityMasks({}, frames, f"files of {path.name}"))
        names = self._names(video, problems)
        of = self._labels if self.config.holds == "labels" else self._entity
        entities = {name: of(path, name, names[name], video, problems) for name in names}
        problems.raise_if_any()
        progress(1.0, "masks")
        return Estimates(EntityMasks(entities, None, f"files of {path.name}"))

    def _names(self, video: VideoRequest, problems: FileDiagnostics) -> dict[str, int | str]:
        """Entity to its folder or number, for each that is requested."""
        requested = [entity.name for entity in video.entities] or list(self.config.names)
        if not requested:
            problems.add("no entities were requested: list them in `names`")
        unknown = [name for name in self.config.names if name not in requested]
        if unknown:
            hint = did_you_mean(unknown[0], requested)
            problems.add(f"names: not requested: {listed_names(unknown)}{hint}")
        if self.config.holds == "labels":
            without = [n for n in requested if not isinstance(self.config.names.get(n), int)]
            if without:
                problems.add(
                    f"names: give the number of {listed_names(without)} in the label images, such "
                    f"as names: {{{without[0]}: 1}}"
                )
            requested = [n for n in requested if n not in without]
        return {name: self.config.names.get(name, name) for name in requested}

    def _entity(
        self,
        path: Path,
        name: str,
        where: int | str,
        video: VideoRequest,
        problems: FileDiagnostics,
    ) -> LazyFrames:
        if path.suffix.lower() == ".npz":
            return self._masks(path, str(where), video, problems)
        if not path.is_dir():
            problems.add(
                f"{path} is one file; holds: entities expects a folder with {where}/ in it, or an "
                ".npz file; for other layouts set holds: labels or together"
            )
            return _nothing(video)
        place = path / str(where)
        if not place.exists():
            beside = [p for p in path.glob(f"{where}.*") if p.suffix in (*VIDEOS, ".npz", ".npy")]
            if not beside:
                problems.add(f"{absent(place)}: the masks of {name}")
                return _nothing(video)
            place = beside[0]
        return self._masks(place, None, video, problems)

    def _labels(
        self,
        path: Path,
        name: str,
        label: int | str,
        video: VideoRequest,
        problems: FileDiagnostics,
    ) -> LazyFrames:
        return self._masks(path, None, video, problems, label=int(label))

    def _masks(
        self,
        path: Path,
        key: str | None,
        video: VideoRequest,
        problems: FileDiagnostics,
        label: int | None = None,
    ) -> LazyFrames:
        """The masks of one place, of whatever form."""
        suffix = path.suffix.lower()
        if path.is_dir():
            return self._folder(path, video, problems, label)
        if suffix in VIDEOS:
            if label is not None:
                problems.add(f"{path}: compression blurs numbers; labels come as .png or .npy")
                return _nothing(video)
            stack = read_video_masks(path, self.config.inside, problems)
            require_count(len(stack), path, video, problems)
            if len(stack) and (why := wrong_size(stack[0].shape[::-1], video, self.config.resize)):
                problems.add(f"{path}: {why}")
            return LazyFrames(video.frames, lambda i: _fitted(stack[i], video))
        if suffix in (".npz", ".npy"):
            return self._array(path, key, video, problems, label)
        problems.add(
            f"{path}: expected a folder, .npz, .npy or a video ({', '.join(VIDEOS)}); one image is "
            "one frame"
        )
        return _nothing(video)

    def _folder(
        self, folder: Path, video: VideoRequest, problems: FileDiagnostics, label: int | None
    ) -> LazyFrames:
        files = numbered(folder, (*IMAGES, ".npy"), video, problems, self.config.first_frame)
        if files and self.config.missing == "refuse":
            require_frames(files, folder, video, problems)
        sizes = {}
        for i in video.numbers:
            if i in files and (size := _size_of(files[i], problems)):
                sizes[files[i]] = size
        require_sizes(sizes, video, self.config.resize, problems)
        read = self._reader(label)

        def mask(i: int) -> Bool[np.ndarray, "H W"]:
            if i not in files:
                if self.config.missing == "refuse":
                    raise HoigsError(f"{folder} has no mask of frame {i}")
                return np.zeros((video.height, video.width), bool)
            return _fitted(read(files[i]), video)

        return LazyFrames(video.frames, mask)

    def _reader(self, label: int | None) -> Callable[[Path], Bool[np.ndarray, "H W"]]:
        if label is not None:
            return lambda path: read_labels(path) == label
        return lambda path: read_mask(path, self.config.inside)

    def _array(
        self,
        path: Path,
        key: str | None,
        video: VideoRequest,
        problems: FileDiagnostics,
        label: int | None,
    ) -> LazyFrames:
        if path.suffix.lower() == ".npy":
            array = load_frames_array(path, problems)
            shape = None if array is None else array.shape
        else:
            shapes = npz_shapes(path, problems)
            if key is None and len(shapes) == 1:
                key = next(iter(shapes))
            if key not in shapes:
                if shapes:
                    wanted = "one array" if key is None else f'an array "{key}"'
                    problems.add(f"{path} holds {', '.join(shapes)}; expected {wanted}")
                return _nothing(video)
            shape, array = shapes[key][0], None
        if shape is None:
            return _nothing(video)
        if len(shape) != 3:
            problems.add(f"{path}: an array of shape {shape}, expected [frames, height, width]")
            return _nothing(video)
        require_count(shape[0], path, video, problems)
        if why := wrong_size((shape[2], shape[1]), video, self.config.resize):
            problems.add(f"{path}: {why}")
        values: list[np.ndarray] = [] if array is None else [array]

        def mask(i: int) -> Bool[np.ndarray, "H W"]:
            if not values:
                values.append(unpacked(path, str(key), video.work))
            found = np.asarray(values[0][i])
            return _fitted(found == label if label is not None else self._inside(found), video)

        return LazyFrames(video.frames, mask)

    def _inside(self, values: Int[np.ndarray, "H W"] | np.ndarray) -> Bool[np.ndarray, "H W"]:
        if values.dtype == bool:
            return ~values if self.config.inside == "dark" else values
        if self.config.inside == "nonzero" or (
            self.config.inside == "auto" and values.max(initial=0) <= 1
        ):
            return values != 0
        return values < 128 if self.config.inside == "dark" else values > 127


def listed_names(names: list[str]) -> str:
    """Quoted, comma-separated."""
    return ", ".join(f'"{name}"' for name in names)


def _size_of(path: Path, problems: FileDiagnostics) -> tuple[int, int] | None:
    if path.suffix.lower() != ".npy":
        return image_size(path, problems)
    array = load_frames_array(path, problems)
    if array is not None and array.ndim != 2:
        problems.add(f"{path}: an array of shape {array.shape}, expected [height, width]")
        return None
    return None if array is None else (array.shape[1], array.shape[0])


def _fitted(mask: Bool[np.ndarray, "h w"], video: VideoRequest) -> Bool[np.ndarray, "H W"]:
    """The mask at the video's size; a pixel counts if at least half of it is covered."""
    from PIL import Image

    if mask.shape == (video.height, video.width):
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * 255)
    return np.asarray(grey.resize((video.width, video.height), Image.Resampling.BOX)) > 127


def _nothing(video: VideoRequest) -> LazyFrames:
    """In place of masks whose fault is in `problems`; reading it raises."""

    def refuse(i: int) -> np.ndarray:
        raise HoigsError(f"the mask of frame {i} cannot be read")

    return LazyFrames(video.frames, refuse)
