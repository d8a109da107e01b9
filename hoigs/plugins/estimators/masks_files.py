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
from hoigs.core.progress import Progress, no_progress
from hoigs.plugins.estimators.common.frame_files import (
    FileDiagnostics,
    absent,
    image_size,
    load_array,
    npz_shapes,
    numbered,
    require_count,
    require_frames,
    require_sizes,
    unpacked,
    wrong_size,
)
from hoigs.plugins.estimators.common.mask_images import (
    IMAGES,
    VIDEOS,
    Inside,
    read_labels,
    read_mask,
    read_video_masks,
)

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
            array = load_array(path, problems)
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
    array = load_array(path, problems)
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
