"""reader:colmap: a folder of images beside COLMAP's sparse model, as the 3DGS family reads it."""

from __future__ import annotations

import re
import shutil
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.errors import ClipError, did_you_mean
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.system.colmap_files import PARTS, choice_told, holds_model, models_in
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, FrameStore, uniform_test_split
from hoigs.core.values.lens import Lens
from hoigs.core.values.tokens import EntityKind
from hoigs.core.values.world import World
from hoigs.plugins.readers.checked_files import Need, VideoReaderConfig, require_files
from hoigs.plugins.readers.lazy_frames import (
    LazyFrames,
    MaskFiles,
    PixelFiles,
    image_files,
    lens_for,
    natural,
    video_moments,
)
from hoigs.plugins.readers.points import points_along_rays, rigid

# A COLMAP model folder: lenses, poses and points, with names as its images have them.

MAKER = "COLMAP makes the sparse model (`colmap mapper`; mask out what moves)"
# of an entry in a binary file: bytes before its own count, of that count, of each that it counts
ENTRY_BYTES = {
    "cameras": (24, 0, 0), "images": (64, 8, 24), "points3D": (43, 8, 8),
    "rigs": (8, 0, 0), "frames": (64, 4, 16),
}  # fmt: skip


@dataclass(frozen=True)
class View:
    """One registered image.

    Attributes:
        name: as in the COLMAP model. world_to_camera: OpenCV axes, COLMAP's own unit.
    """

    name: str
    lens: Lens
    world_to_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class SparseModel:
    """Views in natural order of their names; points and RGB in [0, 1]."""

    views: list[View]
    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    summary: str


def model_folder(folder: Path, place: str | None = None) -> str | None:
    """The model under `folder`, complete or not: the largest in sparse/, the first of equal ones,
    or the one in `place`; None: there is none."""
    if place is not None:
        return place if holds_model(folder / place) else None
    found = models_in(folder / "sparse")
    return f"sparse/{max(found, key=lambda n: found[n])}".rstrip("/") if found else None


def sparse_needs(
    folder: Path, place: str | None = None, points: bool = True, maker: str = MAKER
) -> list[Need]:
    """The files of a sparse model, in the form (binary or text) that is there already."""
    whole = model_folder(folder, place) is None
    place = model_folder(folder, place) or place or "sparse/0"
    parts = PARTS if points else PARTS[:2]
    form = "txt" if any((folder / place / f"{p}.txt").is_file() for p in PARTS) else "bin"
    if all((folder / place / f"{p}.bin").is_file() for p in parts):
        form = "bin"
    other = "bin" if form == "txt" else "txt"
    return [
        Need((f"{place}/{p}.{form}", f"{place}/{p}.{other}") if whole else (f"{place}/{p}.{form}",),
             maker)
        for p in parts
    ]  # fmt: skip


def read_sparse(folder: Path) -> SparseModel:
    """The model in `folder`; one without points3D has no points.

    Raises:
        ClipError: it is damaged, or registers no image.
    """
    from hoigs.core.system.colmap import read_model

    _require_counts_fit(folder)
    try:
        if any((folder / f"points3D.{s}").is_file() for s in ("bin", "txt")):
            model: Any = read_model(folder)
        else:
            model = _without_points(folder)
        registered = sorted(model.images.values(), key=lambda i: natural(i.name))
    except (RuntimeError, ValueError, IndexError) as error:
        raise ClipError(f"{folder} is not a readable COLMAP model: {error}") from error
    for number, camera in model.cameras.items():
        if not np.isfinite(camera.params).all() or min(camera.width, camera.height) < 1:
            raise ClipError(f"{folder}: camera {number} is {camera.todict()}; run COLMAP again")
    lenses = {}
    for number, c in model.cameras.items():
        params = tuple(float(p) for p in c.params)
        try:
            lenses[number] = Lens(c.model_name, params, c.width, c.height)
        except ClipError as error:
            raise ClipError(f"{folder}: camera {number}: {error}") from error
    views = []
    for image in registered:
        if image.has_pose:
            pose = np.asarray(image.cam_from_world().matrix(), np.float64)
            name = image.name.replace("\\", "/")  # of a COLMAP on Windows
            views.append(View(name, lenses[image.camera_id], rigid(pose[:, :3], pose[:, 3])))
    if not views:
        raise ClipError(
            f"{folder} registers no image; run COLMAP again, with moving objects masked"
        )
    points = list(model.points3D.values())
    places = torch.tensor(np.array([p.xyz for p in points]).reshape(-1, 3)).float()
    if not places.isfinite().all():
        raise ClipError(f"{folder}: points are not finite; run COLMAP again")
    models = ", ".join(sorted({lens.model for lens in lenses.values()}))
    return SparseModel(
        views,
        places,
        torch.tensor(np.array([p.color for p in points]).reshape(-1, 3)).float() / 255,
        f"COLMAP {models}, {len(views)} images, {len(points)} points",
    )


def _require_counts_fit(folder: Path) -> None:
    """Counts in binary files fit the files: pycolmap believes them, and reads for minutes.

    Raises:
        ClipError: a file says that it has more than it holds.
    """
    for part, (head, width, each) in ENTRY_BYTES.items():
        path = folder / f"{part}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        count, place = int.from_bytes(data[:8], "little"), 8
        whole = len(data) >= 8 + count * (head + width)
        for _ in range(count if whole and width else 0):
            place += head
            if part == "images":
                place = data.find(b"\0", place) + 1 or len(data)  # the name
            place += width + each * int.from_bytes(data[place : place + width], "little")
            if place > len(data):
                whole = False
                break
        if not whole:
            raise ClipError(
                f"{path} is not a readable COLMAP file: it says {count:,} entries, which do not "
                f"fit its {len(data):,} bytes; copy it again, or run COLMAP again"
            )


def _without_points(folder: Path) -> Any:
    """cameras.txt and images.txt alone: pycolmap needs all three files, and tracks that exist."""
    from hoigs.core.system.colmap import read_model

    lines = (folder / "images.txt").read_text(encoding="utf-8").split("\n")
    rows = [line for line in lines if not line.startswith("#")]
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        shutil.copy(folder / "cameras.txt", place)
        # each image has two lines; the second has its observations and may be empty
        (place / "images.txt").write_text("".join(f"{row}\n\n" for row in rows[::2] if row.strip()))
        (place / "points3D.txt").write_text("")
        return read_model(place)


LAYOUT = "a COLMAP folder (images/ and sparse/)"
NEAREST, FARTHEST = 0.5, 50.0  # where a scene without points may be; 1: the cameras' way
MASK_MAKER = "your segmenter makes masks/ENTITY/, 0/255, one for each image; or remove the folder"
NO_POSES = "a COLMAP folder holds none; `hoigs prepare` fits a body to landmarks"


class ColmapConfig(VideoReaderConfig):
    """Settings of reader:colmap."""

    factor: int = Field(default=1, ge=1, description="2 reads images_2/, and so on")
    model: str | None = Field(
        default=None, description="the model's folder (sparse/0); default: the largest in sparse/"
    )
    camera: str | None = Field(
        default=None,
        description="images of this folder in images/ alone, where each camera has one; else all",
    )
    points: int = Field(
        default=20_000, ge=1, description="scene points to start from where the model has none"
    )
    test_every: int | None = Field(
        default=None,
        ge=2,
        description="every n-th image is for tests, from the first on (3DGS: 8); else 16, evenly",
    )


class ColmapReader(ClipReader):
    """Cameras and points of a sparse model, in COLMAP's own unit; distortion is taken out.

    Images are in natural order of their names. One that COLMAP could not register is left out,
    but keeps its time. Where folders in images/ have frames of equal numbers, they are cameras
    that run at once: equal numbers are of one time.

    `masks/NAME/` holds the masks of an entity: a human if NAME starts with "human" or "person",
    else an object. Mask files directly in `masks/` are COLMAP's own (pixels without features) and
    are not read.
    """

    Config: ClassVar = ColmapConfig
    config: ColmapConfig
    general = True  # NeuMan, ExAvatar and nerfstudio have a COLMAP model too

    def matches(self, folder: Path) -> bool:
        return model_folder(Path(folder)) is not None and (Path(folder) / "images").is_dir()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        image_folder = "images" if self.config.factor == 1 else f"images_{self.config.factor}"
        shrink = "the video's frames, the ones that COLMAP was run on"
        if (factor := self.config.factor) != 1:
            shrink = f"images at 1/{factor} size: `mogrify -resize {100 / factor:g}%`"
        chosen = self.config.model
        needs = [Need.of(f"{image_folder}/", maker=shrink), *sparse_needs(folder, chosen)]
        require_files(folder, LAYOUT, needs)
        place = model_folder(folder, chosen)
        assert place is not None  # require_files has found it
        told = choice_told(folder / "sparse", folder / place) if chosen is None else None
        if told:
            warnings.warn(f"{told}; --reader-set model={place} takes it always", stacklevel=2)
        model = read_sparse(folder / place)
        files = _by_stem(folder / image_folder)
        if self.config.camera is not None:
            model, files = _of_camera(self.config.camera, model, files)
        stems = [_stem(view.name, files) for view in model.views]
        masks = mask_folders(folder)
        needs = [Need.of(f"{image_folder}/{v.name}", maker=shrink)
                 for v, stem in zip(model.views, stems) if stem not in files]  # fmt: skip
        for name in masks:
            needs += [Need.of(f"masks/{name}/{s}.png", maker=MASK_MAKER) for s in stems]
        require_files(folder, LAYOUT, needs)
        images = [files[stem] for stem in stems]
        lenses = [lens_for(view.lens, path) for view, path in zip(model.views, images)]
        cameras = [lens.camera(v.world_to_camera) for lens, v in zip(lenses, model.views)]
        paths = {n: [folder / "masks" / n / f"{s}.png" for s in stems] for n in masks}
        pixels = PixelFiles(images, masks={n: MaskFiles(paths[n]) for n in masks})
        store = LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb)
        points, colors, origin = self._points(model, store, cameras, tuple(masks))
        order, count = _instants(files)
        at_once = "" if count == len(files) else f"; {len(files)} images of {count} instants"
        return Clip(
            name=folder.resolve().name,
            store=store,
            cameras=cameras,
            moments=video_moments([order[stem] for stem in stems], count),
            kinds=masks,
            points=points,
            point_colors=colors,
            split=split_of(len(images), self.config.test_every),
            world=World.guessed(cameras, metres=False),
            fps=self.config.fps,
            provenance={
                "reader": "reader:colmap",
                "cameras": f"{place}: {model.summary}; world in COLMAP's unit{at_once}",
                "points": origin,
                **{f"poses of {n}": NO_POSES for n, kind in masks.items() if kind == "human"},
            },
        )

    def _points(
        self,
        model: SparseModel,
        store: FrameStore,
        cameras: Sequence[Camera],
        entities: Sequence[str],
    ) -> tuple[Tensor, Tensor, str]:
        """The model's; where it has none, at random depths about the distance that the cameras
        move by, as for cameras that go round a scene."""
        if len(model.points):
            return model.points, model.colors, "COLMAP's"
        centers = torch.stack([camera.center for camera in cameras])
        reach = float((centers - centers.mean(0)).norm(dim=-1).max()) or 1.0
        span = (NEAREST * reach, FARTHEST * reach)
        points, colors = points_along_rays(store, cameras, entities, span, self.config.points)
        return points, colors, f"random, along rays, {span[0]:.3g} to {span[1]:.3g} away"


def _of_camera(
    name: str, model: SparseModel, files: Mapping[str, Path]
) -> tuple[SparseModel, dict[str, Path]]:
    """The views and images of one camera's folder alone.

    Raises:
        ClipError: it has none.
    """
    views = [view for view in model.views if view.name.startswith(f"{name}/")]
    if not views:
        known = sorted({v.name.rpartition("/")[0] for v in model.views})
        raise ClipError(
            f"camera: no registered image is in {name}/{did_you_mean(name, known)}; the model has "
            f"images in {', '.join(repr(k) for k in known)}"
        )
    kept = {stem: path for stem, path in files.items() if stem.startswith(f"{name}/")}
    return replace(model, views=views), kept


def _instants(files: Mapping[str, Path]) -> tuple[dict[str, int], int]:
    """When each image was taken, as the number of an instant, and how many instants there are.

    Images of one folder are a video. Folders are cameras that run at once if images in them have
    equal numbers (the last in their names; equal names, where some have no number or share one);
    else their images follow each other.
    """
    folders: dict[str, list[str]] = {}
    for stem in files:
        folders.setdefault(stem.rpartition("/")[0], []).append(stem)
    for key in (_number, _name):
        keys = {folder: [key(stem) for stem in stems] for folder, stems in folders.items()}
        if any(None in found or len(set(found)) < len(found) for found in keys.values()):
            continue
        instants = sorted({str(k) for found in keys.values() for k in found}, key=natural)
        if len(instants) < len(files):
            place = {instant: i for i, instant in enumerate(instants)}
            return {stem: place[str(key(stem))] for stem in files}, len(instants)
    return {stem: i for i, stem in enumerate(files)}, len(files)


def _number(stem: str) -> int | None:
    digits = re.findall(r"\d+", _name(stem))
    return int(digits[-1]) if digits else None


def _name(stem: str) -> str:
    return stem.rpartition("/")[2]


def _by_stem(root: Path) -> dict[str, Path]:
    """Images of a folder and its subfolders (one for each camera), by path without suffix."""
    folders = [root, *sorted(p for p in root.rglob("*") if p.is_dir())]
    files = [path for each in folders for path in image_files(each)]
    return {path.relative_to(root).with_suffix("").as_posix(): path for path in files}


def _stem(name: str, files: Mapping[str, Path]) -> str:
    """The key in `files` of a COLMAP image name, whose folders may no longer exist."""
    whole = Path(name).with_suffix("").as_posix()
    return whole if whole in files else Path(name).stem


def mask_folders(folder: Path) -> dict[str, EntityKind]:
    """Name and kind of each entity, one for each folder in masks/."""
    names = sorted(p.name for p in (folder / "masks").glob("*") if p.is_dir())
    people = ("human", "person")
    return {name: "human" if name.lower().startswith(people) else "object" for name in names}


def split_of(count: int, every: int | None) -> dict[str, list[int]]:
    """Training and test positions; see ColmapConfig.test_every."""
    if every is None:
        return uniform_test_split(count)
    test = list(range(0, count, every))
    return {"train": [i for i in range(count) if i % every], "test": test}
