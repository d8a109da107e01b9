"""reader:hypernerf: captures as Nerfies and HyperNeRF published them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.values.clip import Clip
from hoigs.core.values.lens import Lens
from hoigs.core.values.moment import Moment
from hoigs.core.values.world import World
from hoigs.plugins.readers.checked_files import (
    Need,
    VideoReaderConfig,
    parse_json,
    parse_json_map,
    require_files,
)
from hoigs.plugins.readers.lazy_frames import (
    DepthFiles,
    LazyFrames,
    MaskFiles,
    PixelFiles,
    dark,
    lens_for,
    natural,
)
from hoigs.plugins.readers.points import Points, checked_rotation, read_points, rigid

LAYOUT = "a Nerfies or HyperNeRF capture (dataset.json, camera/ …)"
MAKER = (
    "the captures have it (github.com/google/hypernerf/releases), and Nerfies' "
    "Nerfies_Capture_Processing.ipynb makes it of your own video"
)
POINT_FILES = ("points3D_downsample2.ply", "points3D_downsample.ply", "points.npy")
USUAL_FACTOR = 2  # the resolution of the published scores


class SceneJson(BaseModel):
    """scene.json: the world is (x - center) * scale."""

    scale: float = Field(gt=0)
    center: tuple[float, float, float]


class DatasetJson(BaseModel):
    """dataset.json: image names by use."""

    ids: list[str] = Field(min_length=1)
    train_ids: list[str] = []
    val_ids: list[str] = []


Identifier = Annotated[int, Field(ge=0, le=10**9)]


class MetadataJson(BaseModel):
    """An entry of metadata.json."""

    warp_id: Identifier
    camera_id: Identifier = 0
    time_id: Identifier | None = None

    @property
    def step(self) -> int:
        return self.warp_id if self.time_id is None else self.time_id


Pixels = Annotated[float, Field(ge=1, le=65536)]
Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class CameraJson(BaseModel):
    """camera/ID.json; orientation is world-to-camera, position the camera's centre."""

    orientation: tuple[Row, Row, Row]
    position: tuple[FiniteFloat, FiniteFloat, FiniteFloat]
    focal_length: FiniteFloat = Field(gt=0)
    principal_point: tuple[FiniteFloat, FiniteFloat]
    image_size: tuple[Pixels, Pixels]
    skew: FiniteFloat = 0.0
    pixel_aspect_ratio: FiniteFloat = Field(default=1.0, gt=0)
    radial_distortion: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, 0.0)
    tangential_distortion: tuple[FiniteFloat, FiniteFloat] = (0.0, 0.0)


class HypernerfConfig(VideoReaderConfig):
    """Settings of reader:hypernerf."""

    factor: int | None = Field(
        default=None,
        ge=1,
        description="reads rgb/FACTORx; by default 2 if there, else the smallest",
    )
    fps: float = Field(default=15.0, gt=0, description="frame rate of the capture")


class HypernerfReader(ClipReader):
    """Frames in order of time, then camera; distortion is taken out.

    The world is (x - center) * scale of scene.json, for cameras, points and depth alike. With no
    val_ids every fourth image trains and the one two later tests, as 4DGaussians does it;
    covisible/ (DyCheck) marks what of a test image can be known, the rest is ignored.
    """

    Config: ClassVar = HypernerfConfig
    config: HypernerfConfig

    def matches(self, folder: Path) -> bool:
        folder = Path(folder)
        return (folder / "dataset.json").is_file() and (folder / "camera").is_dir()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        names = ("dataset.json", "metadata.json", "scene.json", "camera/")
        require_files(folder, LAYOUT, [Need.of(name, maker=MAKER) for name in names])
        dataset = parse_json(folder / "dataset.json", DatasetJson)
        scene = parse_json(folder / "scene.json", SceneJson)
        metadata = parse_json_map(folder / "metadata.json", MetadataJson)
        image_folder = f"rgb/{self.config.factor or _usual_factor(folder)}x"
        require_files(folder, LAYOUT, _needs(dataset, image_folder), _problems(dataset, metadata))
        ids = sorted(
            dataset.ids, key=lambda i: (metadata[i].step, metadata[i].camera_id, natural(i))
        )
        images = [folder / image_folder / f"{name}.png" for name in ids]
        cameras, lenses = [], []
        for name, image in zip(ids, images):
            path = folder / "camera" / f"{name}.json"
            lens, w2c = _camera(path, parse_json(path, CameraJson), scene)
            lenses.append(lens_for(lens, image))
            cameras.append(lenses[-1].camera(w2c))
        split = _split(dataset, ids)
        depths = _optional(folder, "depth/*x", ids, ".npy")
        seen = _optional(folder, "covisible/*x/val", ids, ".png")
        points, colors, origin = _points(folder, scene)
        last = max(1, *(metadata[name].step for name in ids))
        pixels = PixelFiles(
            images,
            ignored=MaskFiles(seen, dark) if any(seen) else None,
            depth=DepthFiles(depths, scene.scale) if any(depths) else None,
        )
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb),
            cameras=cameras,
            moments=[Moment(metadata[n].step / last, metadata[n].step) for n in ids],
            points=points,
            point_colors=colors,
            split=split,
            world=World.guessed(cameras, metres=False),
            fps=self.config.fps,
            depth_kind="metric" if any(depths) else "none",
            provenance={
                "reader": "reader:hypernerf",
                "cameras": f"the capture's, (x - {list(scene.center)}) * {scene.scale:g}",
                "images": image_folder,
                "points": origin,
            },
        )


def _usual_factor(folder: Path) -> int:
    factors = sorted(int(p.name[:-1]) for p in (folder / "rgb").glob("*x") if p.name[:-1].isdigit())
    return USUAL_FACTOR if USUAL_FACTOR in factors or not factors else factors[0]


def _needs(dataset: DatasetJson, image_folder: str) -> list[Need]:
    needs = [Need.of(*POINT_FILES[::-1], maker=MAKER)]
    for name in dataset.ids:
        needs.append(Need.of(f"camera/{name}.json", maker=MAKER))
        needs.append(Need.of(f"{image_folder}/{name}.png", maker=MAKER))
    return needs


def _problems(dataset: DatasetJson, metadata: dict[str, MetadataJson]) -> list[str]:
    problems = []
    unknown = [name for name in dataset.ids if name not in metadata]
    if unknown:
        problems.append(f"metadata.json has no {', '.join(unknown[:4])} of dataset.json's ids")
    known = set(dataset.ids)
    for key, names in (("train_ids", dataset.train_ids), ("val_ids", dataset.val_ids)):
        unknown_ids = [name for name in names if name not in known]
        if unknown_ids:
            problems.append(
                f"dataset.json: {key} has {', '.join(unknown_ids[:4])}: not among its ids"
            )
    if dataset.val_ids and not dataset.train_ids:
        problems.append("dataset.json has val_ids and no train_ids")
    return problems


def _camera(path: Path, camera: CameraJson, scene: SceneJson) -> tuple[Lens, np.ndarray]:
    """The lens at full size, and world-to-camera."""
    if abs(camera.skew) > 1e-6:
        raise ClipError(f"{path}: skew is {camera.skew:g}; a pinhole camera here has none")
    f, (k1, k2, k3), (p1, p2) = (
        camera.focal_length, camera.radial_distortion, camera.tangential_distortion
    )  # fmt: skip
    cx, cy = camera.principal_point
    K = np.array([[f, 0, cx], [0, f * camera.pixel_aspect_ratio, cy], [0, 0, 1]])
    width, height = (round(n) for n in camera.image_size)
    rotation = checked_rotation(np.array(camera.orientation, np.float64), str(path))
    center = (np.array(camera.position) - scene.center) * scene.scale
    return Lens.opencv(K, (k1, k2, p1, p2, k3), width, height), rigid(rotation, -rotation @ center)


def _split(dataset: DatasetJson, ids: Sequence[str]) -> dict[str, list[int]]:
    train, test = set(dataset.train_ids), set(dataset.val_ids)
    if not dataset.val_ids:
        fourth = dataset.ids[::4]
        train, test = set(fourth), set(dataset.ids[2::4][: max(len(fourth) - 1, 0)])
    return {
        "train": [i for i, name in enumerate(ids) if name in train],
        "test": [i for i, name in enumerate(ids) if name in test],
    }


def _optional(folder: Path, pattern: str, ids: Sequence[str], suffix: str) -> list[Path | None]:
    """Each frame's file, or None, in the folder of the highest resolution that matches."""
    found = sorted(folder.glob(pattern), key=lambda p: natural(p.as_posix()))
    if not found:
        return [None] * len(ids)
    paths = [found[0] / f"{name}{suffix}" for name in ids]
    return [path if path.is_file() else None for path in paths]


def _points(folder: Path, scene: SceneJson) -> tuple[*Points, str]:
    path = next(folder / name for name in POINT_FILES if (folder / name).is_file())
    points, colors = read_points(path)
    points = (points - points.new_tensor(scene.center)) * scene.scale
    if not points.isfinite().all():
        raise ClipError(f"{path}: points are not finite at the center and scale of scene.json")
    return points, colors, path.name
