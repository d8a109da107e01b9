"""reader:davis: frames and annotated masks, as DAVIS and DreamScene4D lay them out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from PIL import Image
from pydantic import Field

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, uniform_test_split
from hoigs.core.values.tokens import EntityKind
from hoigs.core.values.world import World
from hoigs.plugins.readers.checked_files import Need, VideoReaderConfig, require_files
from hoigs.plugins.readers.lazy_frames import (
    LazyFrames,
    MaskFiles,
    PixelFiles,
    image_files,
    image_size,
    opened,
    video_moments,
)
from hoigs.plugins.readers.points import points_along_rays

LAYOUT = "a DAVIS sequence (JPEGImages/SEQUENCE)"
FRAMES = "the video's frames, as DAVIS (davischallenge.org) or your own decoder writes them"
ANNOTATIONS = "DAVIS has it, or DEVA's tracks as DreamScene4D writes them, a folder for each object"
NO_CAMERAS = "none published; a static camera with a focal length of {focal:.1f} px is assumed"
NO_POSES = "DAVIS has none; `hoigs prepare` fits a body to landmarks"
VOID = 255  # DAVIS's index of pixels that are not scored
SPAN = (1.0, 5.0)  # depths of the points to start from, in units of their own


class DavisConfig(VideoReaderConfig):
    """Settings of reader:davis."""

    people: list[int] = Field(
        default_factory=list, description="ids of annotated objects that are people"
    )
    focal: float | None = Field(
        default=None, gt=0, description="pixels; by default 1.2 times the longer side (COLMAP's)"
    )
    points: int = Field(default=20_000, ge=1, description="scene points to start from")
    fps: float = Field(default=24.0, gt=0, description="frame rate of the video (DAVIS: 24)")


class DavisReader(ClipReader):
    """Frames and masks of every annotated object: "object_1", … or "human_1" of `people`.

    Annotations are palette images whose index is the object (DAVIS), or one folder of binary
    masks for each object (DreamScene4D). There are no cameras, so a static one at the origin is
    assumed. There is no depth, so the scene has no unit. Objects have no track, so a spec names an
    initializer for each.
    """

    Config: ClassVar = DavisConfig
    config: DavisConfig

    def matches(self, folder: Path) -> bool:
        return "JPEGImages" in Path(folder).resolve().parts[-3:-1]

    def read(self, folder: Path) -> Clip:
        folder = Path(folder).resolve()
        if not self.matches(folder):
            require_files(folder, LAYOUT, [])
            raise ClipError(
                f"{folder} is not a folder within JPEGImages/: give JPEGImages/SEQUENCE, with "
                "Annotations/ beside JPEGImages/"
            )
        images = image_files(folder)
        parts = list(folder.parts)
        level = len(parts) - 1 - parts[::-1].index("JPEGImages")
        root = Path(*parts[:level])
        own = Path("Annotations", *parts[level + 1 :])
        sequence = Path("JPEGImages", *parts[level + 1 :])
        needs = [] if images else [Need.of(f"{sequence}/00000.jpg", maker=FRAMES)]
        folders = sorted(p for p in (root / own).glob("*") if p.is_dir() and p.name.isdigit())
        for place in [own / r.name for r in folders] or [own]:
            needs += [Need.of(f"{place}/{p.stem}.png", maker=ANNOTATIONS) for p in images]
            needs += [] if images else [Need.of(f"{place}/00000.png", maker=ANNOTATIONS)]
        require_files(root, LAYOUT, needs)
        masks = _folders(folders, images) if folders else _palettes(root / own, images)
        if not masks:
            raise ClipError(f"{root / own}: no object is marked in any frame")
        unknown = sorted(set(self.config.people) - set(masks))
        if unknown:
            raise ClipError(f"people={unknown}: annotated objects are {sorted(masks)}")
        names = {i: f"{'human' if i in self.config.people else 'object'}_{i}" for i in masks}
        kinds: dict[str, EntityKind] = {
            names[i]: "human" if i in self.config.people else "object" for i in masks
        }
        width, height = image_size(images[0])
        focal = self.config.focal or 1.2 * max(width, height)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras = [Camera(K, torch.eye(4), width, height)] * len(images)
        store = LazyFrames(
            root,
            PixelFiles(images, masks={names[i]: files for i, files in masks.items()}),
            cameras,
            cache_mb=self.config.cache_mb,
        )
        points, colors = points_along_rays(store, cameras, tuple(kinds), SPAN, self.config.points)
        return Clip(
            name=folder.name,
            store=store,
            cameras=cameras,
            moments=video_moments(range(len(images)), len(images)),
            kinds=kinds,
            points=points,
            point_colors=colors,
            split=uniform_test_split(len(images)),
            world=World.guessed(cameras, metres=False),
            fps=self.config.fps,
            provenance={
                "reader": "reader:davis",
                "cameras": NO_CAMERAS.format(focal=focal),
                "points": f"random, {SPAN[0]:g} to {SPAN[1]:g} away, in no unit",
                **{f"poses of {n}": NO_POSES for n, k in kinds.items() if k == "human"},
            },
        )


def _folders(folders: Sequence[Path], images: Sequence[Path]) -> dict[int, MaskFiles]:
    """DreamScene4D's masks: folders 001/, 002/, …; every value but 0 is the object."""
    return {
        int(folder.name): MaskFiles([folder / f"{p.stem}.png" for p in images], _shown)
        for folder in folders
    }


def _palettes(folder: Path, images: Sequence[Path]) -> dict[int, MaskFiles]:
    """DAVIS's masks: one image for each frame. All are read, as an object may enter late."""
    paths = [folder / f"{p.stem}.png" for p in images]
    seen: set[int] = set()
    for path in paths:
        seen.update(np.unique(_indices(opened(path))).tolist())
    return {i: MaskFiles(paths, partial(_index, i)) for i in sorted(seen - {0, VOID})}


def _indices(image: Image.Image) -> np.ndarray:
    if image.mode not in ("P", "L"):
        raise ClipError(
            f"{getattr(image, 'filename', 'an annotation')} has mode {image.mode}; expected "
            "palette indices (P) or grey (L) whose value is the object"
        )
    return np.asarray(image)


def _index(number: int, image: Image.Image) -> np.ndarray:
    return _indices(image) == number


def _shown(image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("L")) > 0
