"""reader:nerfstudio: one transforms.json for a captured scene, as ns-process-data writes it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, Field, FiniteFloat, field_validator

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, uniform_test_split
from hoigs.core.values.lens import Lens
from hoigs.core.values.moment import Moment
from hoigs.plugins.readers.checked_files import Need, VideoReaderConfig, parse_json, require_files
from hoigs.plugins.readers.lazy_frames import (
    DepthFiles,
    LazyFrames,
    MaskFiles,
    PixelFiles,
    dark,
    image_size,
    lens_for,
    natural,
    timed_moments,
    video_moments,
)
from hoigs.plugins.readers.points import (
    Points,
    opengl_to_world_to_camera,
    points_in_box,
    read_points,
)

# transforms.json, the camera file of Blender scenes (NeRF, D-NeRF) and nerfstudio.


# nerfstudio's camera models -> whether the lens is a fisheye
PERSPECTIVE = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV",
               "FULL_OPENCV")  # fmt: skip
FISHEYE = ("FISHEYE", "OPENCV_FISHEYE")


class Intrinsics(BaseModel):
    """Keys at the top of the file or in a frame; those of the frame take precedence."""

    camera_model: str | None = None
    camera_angle_x: FiniteFloat | None = None
    fl_x: FiniteFloat | None = None
    fl_y: FiniteFloat | None = None
    cx: FiniteFloat | None = None
    cy: FiniteFloat | None = None
    w: FiniteFloat | None = None
    h: FiniteFloat | None = None
    k1: FiniteFloat | None = None
    k2: FiniteFloat | None = None
    k3: FiniteFloat | None = None
    k4: FiniteFloat | None = None
    p1: FiniteFloat | None = None
    p2: FiniteFloat | None = None


# a path of the file, which Windows writes with backslashes
DataPath = Annotated[str, AfterValidator(lambda path: path.replace("\\", "/"))]


class TransformFrame(Intrinsics):
    """One image."""

    file_path: DataPath
    transform_matrix: list[list[FiniteFloat]]
    time: FiniteFloat | None = None
    mask_path: DataPath | None = None
    depth_file_path: DataPath | None = None

    @field_validator("transform_matrix")
    @classmethod
    def _is_4x4(cls, rows: list[list[float]]) -> list[list[float]]:
        if [len(row) for row in rows] not in ([4] * 4, [4] * 3):
            raise ValueError("expected 4 rows of 4 numbers")
        return rows

    @property
    def camera_to_world(self) -> np.ndarray:
        return np.array([*self.transform_matrix[:3], [0, 0, 0, 1]], np.float64)


class Transforms(Intrinsics):
    """The file."""

    frames: list[TransformFrame]
    applied_transform: list[list[FiniteFloat]] | None = None
    applied_scale: FiniteFloat = 1.0
    ply_file_path: DataPath | None = None
    train_filenames: list[DataPath] | None = None
    val_filenames: list[DataPath] | None = None
    test_filenames: list[DataPath] | None = None


def lens_of(file: Transforms, frame: TransformFrame, image: Path, where: str) -> Lens:
    """The lens of a frame at the size that its image has.

    The centre of the top-left pixel is at (0.5, 0.5) in these files: COLMAP's and Blender's rule.

    Args:
        where: names the frame in errors.

    Raises:
        ClipError: no focal length, or a lens model that cannot be undistorted.
    """

    def get(key: str) -> float:
        own = getattr(frame, key)
        value = own if own is not None else getattr(file, key)
        return 0.0 if value is None else float(value)

    width, height = image_size(image)
    w, h = int(get("w")) or width, int(get("h")) or height
    fx = get("fl_x")
    if fx == 0 and get("camera_angle_x") > 0:
        fx = 0.5 * w / math.tan(0.5 * get("camera_angle_x"))
    if fx <= 0:
        raise ClipError(f"{where}: no focal length; expected fl_x (pixels) or camera_angle_x (rad)")
    fy = get("fl_y") or fx
    # a principal point of 0 counts as absent; the default is the centre of the image
    center = [get("cx") or w / 2, get("cy") or h / 2]
    k1, k2, k3, k4, p1, p2 = (get(k) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = frame.camera_model or file.camera_model or "PERSPECTIVE"
    if model in FISHEYE:
        params = (fx, fy, *center, k1, k2, k3, k4)
        return lens_for(Lens("OPENCV_FISHEYE", params, w, h), image)
    if model not in PERSPECTIVE:
        raise ClipError(
            f"{where}: camera_model {model} has no pinhole image; this reads "
            f"{', '.join((*PERSPECTIVE, *FISHEYE))}"
        )
    if k4 != 0:
        raise ClipError(f"{where}: k4 = {k4:g} on a {model} lens: only fisheyes have a k4 here")
    K = np.array([[fx, 0, center[0]], [0, fy, center[1]], [0, 0, 1]])
    return lens_for(Lens.opencv(K, (k1, k2, p1, p2, k3), w, h), image)


LAYOUT = "a nerfstudio capture (transforms.json)"
MAKER = "`ns-process-data images` or `video` writes transforms.json and the images beside it"
MASK_MAKER = "your segmenter makes it: black where pixels are ignored; or remove mask_path"
DEPTH_MAKER = "your capture app or depth network makes it; or remove depth_file_path"
RANDOM_BOX = 5.0  # times the largest camera coordinate: splatfacto's random_scale of 10


class NerfstudioConfig(VideoReaderConfig):
    """Settings of reader:nerfstudio."""

    factor: int = Field(default=1, ge=1, description="2 reads images_2/, and so on")
    depth_unit: float = Field(default=0.001, gt=0, description="metres in a depth file's 1")
    points: int = Field(
        default=50_000, ge=1, description="random points to start from where there is no PLY"
    )


class NerfstudioReader(ClipReader):
    """Frames in natural order of their names, as nerfstudio sorts them, whatever the file's order.

    The world is the file's, divided by its `applied_scale`, which restores the metres of
    capture apps. Masks are nerfstudio's: black pixels are ignored. Depth is in metres. Frames
    without "time" are evenly spaced.
    """

    Config: ClassVar = NerfstudioConfig
    config: NerfstudioConfig

    def matches(self, folder: Path) -> bool:
        return (Path(folder) / "transforms.json").is_file()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        require_files(folder, LAYOUT, [Need.of("transforms.json", maker=MAKER)])
        file = parse_json(folder / "transforms.json", Transforms)
        rows = sorted(enumerate(file.frames), key=lambda row: natural(row[1].file_path))
        frames = [frame for _, frame in rows]
        require_files(folder, LAYOUT, self._needs(file, frames), _problems(file, frames))
        wheres = [f"{folder / 'transforms.json'}: frames.{i}" for i, _ in rows]
        images = [folder / self._image(frame) for frame in frames]
        lenses = [lens_of(file, *each) for each in zip(frames, images, wheres)]
        cameras = []
        for lens, frame, where in zip(lenses, frames, wheres):
            w2c = opengl_to_world_to_camera(frame.camera_to_world, where)
            w2c[:3, 3] /= file.applied_scale
            cameras.append(lens.camera(w2c))
        split = _split(file, frames)
        depths = [folder / f.depth_file_path if f.depth_file_path else None for f in frames]
        masks = [folder / f.mask_path if f.mask_path else None for f in frames]
        points, colors, origin = self._points(folder, file, cameras)
        pixels = PixelFiles(
            images,
            ignored=MaskFiles(masks, dark) if any(masks) else None,
            depth=DepthFiles(depths, self.config.depth_unit) if any(depths) else None,
        )
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb),
            cameras=cameras,
            moments=_moments(frames, split["train"]),
            points=points,
            point_colors=colors,
            split=split,
            fps=self.config.fps,
            depth_kind="metric" if any(depths) else "none",
            provenance={
                "reader": "reader:nerfstudio",
                "cameras": f"transforms.json, applied_scale {file.applied_scale:g} undone",
                "points": origin,
            },
        )

    def _image(self, frame: TransformFrame) -> str:
        if self.config.factor == 1:
            return frame.file_path
        return f"images_{self.config.factor}/{Path(frame.file_path).name}"

    def _needs(self, file: Transforms, frames: Sequence[TransformFrame]) -> list[Need]:
        needs = [Need.of(self._image(frame), maker=MAKER) for frame in frames]
        for frame in frames:
            if frame.mask_path:
                needs.append(Need.of(frame.mask_path, maker=MASK_MAKER))
            if frame.depth_file_path:
                needs.append(Need.of(frame.depth_file_path, maker=DEPTH_MAKER))
        if file.ply_file_path:
            needs.append(Need.of(file.ply_file_path, maker="`ns-process-data`; or remove its key"))
        return needs

    def _points(
        self, folder: Path, file: Transforms, cameras: Sequence[Camera]
    ) -> tuple[*Points, str]:
        if file.ply_file_path:
            # in the file's axes, but before applied_scale (nerfstudio_dataparser: _load_3D_points)
            return (*read_points(folder / file.ply_file_path), file.ply_file_path)
        centers = torch.stack([camera.center for camera in cameras])
        middle = centers.mean(0)
        reach = RANDOM_BOX * max(float((centers - middle).abs().max()), 1e-6)
        count = self.config.points
        points, colors = points_in_box(count, reach)
        origin = f"{count} at random within ±{reach:.3g} of the cameras, as splatfacto does"
        return middle + points, colors, origin


def _problems(file: Transforms, frames: Sequence[TransformFrame]) -> list[str]:
    problems = [] if frames else ["transforms.json has no frames"]
    timed = sum(frame.time is not None for frame in frames)
    if 0 < timed < len(frames):
        problems.append(
            f'transforms.json: {timed} of {len(frames)} frames have a "time"; all or none'
        )
    if file.applied_scale <= 0:
        problems.append(f"transforms.json: applied_scale is {file.applied_scale:g}; expected > 0")
    named, known = _named(file), {_plain(frame.file_path) for frame in frames}
    for key, names in named.items():
        unknown = [name for name in names if name not in known]
        if unknown:
            problems.append(f"transforms.json: {key} lists {', '.join(unknown[:4])}: not in frames")
    if named and "train_filenames" not in named:
        problems.append(f"transforms.json has {', '.join(named)} and no train_filenames")
    return problems


def _plain(path: str) -> str:
    return path.removeprefix("./")


def _named(file: Transforms) -> dict[str, list[str]]:
    keys = ("train_filenames", "val_filenames", "test_filenames")
    lists: dict[str, list[str] | None] = {key: getattr(file, key) for key in keys}
    return {key: [_plain(n) for n in names] for key, names in lists.items() if names is not None}


def _split(file: Transforms, frames: Sequence[TransformFrame]) -> Mapping[str, list[int]]:
    """The file's lists; where it has no test list, val is for tests; without any, 16 evenly."""
    named = _named(file)
    if not named:
        return uniform_test_split(len(frames))
    split = {
        key.removesuffix("_filenames"): [
            i for i, frame in enumerate(frames) if _plain(frame.file_path) in names
        ]
        for key, names in named.items()
    }
    if not split.get("test"):
        split["test"] = split.pop("val", [])
    return split


def _moments(frames: Sequence[TransformFrame], train: Sequence[int]) -> list[Moment]:
    times = [frame.time for frame in frames if frame.time is not None]
    if len(times) == len(frames):
        return timed_moments(times, train)
    return video_moments(range(len(frames)), len(frames))
