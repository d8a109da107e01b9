"""reader:dnerf: Blender scenes with a time for each frame, as D-NeRF published them."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.values.clip import Clip
from hoigs.core.values.world import World
from hoigs.plugins.readers.checked_files import Need, ReaderConfig, parse_json, require_files
from hoigs.plugins.readers.lazy_frames import LazyFrames, PixelFiles, timed_moments
from hoigs.plugins.readers.nerfstudio import TransformFrame, Transforms, lens_of
from hoigs.plugins.readers.points import (
    Points,
    opengl_to_world_to_camera,
    points_in_box,
    read_points,
)

LAYOUT = "a D-NeRF scene (transforms_train.json …)"
MAKER = "D-NeRF's data.zip has it (github.com/albertpumarola/D-NeRF), or a Blender export script"
POINT_FILES = ("fused.ply", "points3d.ply", "points3D.ply")
COLORS = {"white": (255, 255, 255), "black": (0, 0, 0)}


class DnerfConfig(ReaderConfig):
    """Settings of reader:dnerf."""

    background: Literal["white", "black"] = Field(
        default="black", description="colour of transparent pixels and of renders"
    )
    points: int = Field(
        default=2000, ge=1, description="random points to start from where no file has any (4DGS)"
    )
    box: float = Field(default=1.3, gt=0, description="their coordinates are between -box and box")


class DnerfReader(ClipReader):
    """Training, validation and test frames of a Blender scene in one clip.

    Images keep their own size, times are the files' (divided by the largest if that exceeds 1).
    The scene has no unit. Test frames have cameras and mostly times of their own.
    """

    Config: ClassVar = DnerfConfig
    config: DnerfConfig

    def matches(self, folder: Path) -> bool:
        return (Path(folder) / "transforms_train.json").is_file()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        names = ["transforms_train.json", "transforms_test.json"]
        require_files(folder, LAYOUT, [Need.of(name, maker=MAKER) for name in names])
        if (folder / "transforms_val.json").is_file():
            names.append("transforms_val.json")
        files = {name: parse_json(folder / name, Transforms) for name in names}
        rows = [(name, i, frame) for name in names for i, frame in enumerate(files[name].frames)]
        untimed = [(name, i) for name, i, frame in rows if frame.time is None]
        problems = [f"{name} has no frames" for name in names[:2] if not files[name].frames]
        if untimed:
            name, i = untimed[0]
            problems.append(
                f'{name}: frames.{i} has no "time" ({len(untimed)} frames of all): a still Blender '
                "scene? D-NeRF's frames have a time from 0 to 1"
            )
        needs = [Need.of(*image_names(frame), maker=MAKER) for _, _, frame in rows]
        require_files(folder, LAYOUT, needs, problems)
        images = [path for need in needs if (path := need.found(folder)) is not None]
        wheres = [f"{folder / name}: frames.{i}" for name, i, _ in rows]
        lenses = [
            lens_of(files[name], frame, image, where)
            for (name, _, frame), image, where in zip(rows, images, wheres)
        ]
        cameras = [
            lens.camera(opengl_to_world_to_camera(frame.camera_to_world, where))
            for lens, (_, _, frame), where in zip(lenses, rows, wheres)
        ]
        split = {
            name.removeprefix("transforms_").removesuffix(".json"): [
                i for i, (own, _, _) in enumerate(rows) if own == name
            ]
            for name in names
        }
        times = [frame.time for _, _, frame in rows if frame.time is not None]
        points, colors, origin = self._points(folder)
        pixels = PixelFiles(images, background=COLORS[self.config.background])
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb),
            cameras=cameras,
            moments=timed_moments(times, split["train"]),
            points=points,
            point_colors=colors,
            split=split,
            world=World(up=(0.0, 0.0, 1.0), metres=False),  # Blender's
            provenance={
                "reader": "reader:dnerf",
                "cameras": "Blender, exact; the scene has no unit",
                "points": origin,
                "images": f"transparent parts over {self.config.background}",
            },
        )

    def _points(self, folder: Path) -> tuple[*Points, str]:
        for name in POINT_FILES:
            if (folder / name).is_file():
                return (*read_points(folder / name), name)
        count, box = self.config.points, self.config.box
        origin = f"{count} at random within ±{box:g} (4DGaussians, readNerfSyntheticInfo)"
        return (*points_in_box(count, box), origin)


def image_names(frame: TransformFrame) -> tuple[str, ...]:
    """Where a frame's image may lie: the layout leaves .png out of its paths."""
    path = frame.file_path.removeprefix("./")
    return (path,) if Path(path).suffix.lower() in (".png", ".jpg") else (f"{path}.png",)
