"""reader:colmap: a folder of images beside COLMAP's sparse model, as the 3DGS family reads it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.values.clip import Clip, uniform_test_split
from hoigs.core.values.tokens import EntityKind
from hoigs.core.values.world import World
from hoigs.plugins.readers.common.colmap_model import model_folder, read_sparse, sparse_needs
from hoigs.plugins.readers.common.config import VideoReaderConfig
from hoigs.plugins.readers.common.frame_order import image_files, video_moments
from hoigs.plugins.readers.common.lazy_frames import LazyFrames, MaskFiles, lens_for
from hoigs.plugins.readers.common.listing import Need, require_files

LAYOUT = "a COLMAP folder (images/ and sparse/)"
MASK_MAKER = "your segmenter makes masks/ENTITY/, 0/255, one for each image; or remove the folder"
NO_POSES = "a COLMAP folder holds none; `hoigs prepare` fits a body to landmarks"


class ColmapConfig(VideoReaderConfig):
    """Settings of reader:colmap."""

    factor: int = Field(default=1, ge=1, description="2 reads images_2/, and so on")
    test_every: int | None = Field(
        default=None,
        ge=2,
        description="every n-th image is for tests, from the first on (3DGS: 8); else 16, evenly",
    )


class ColmapReader(ClipReader):
    """Cameras and points of a sparse model, in COLMAP's own unit; distortion is taken out.

    Images are in natural order of their names. One that COLMAP could not register is left out,
    but keeps its time. `masks/NAME/` holds the masks of an entity: a human if NAME starts with
    "human" or "person", else an object. Mask files directly in `masks/` are COLMAP's own
    (pixels without features) and are not read.
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
        needs = [Need.of(f"{image_folder}/", maker=shrink), *sparse_needs(folder)]
        require_files(folder, LAYOUT, needs)
        place = model_folder(folder)
        assert place is not None  # require_files has found it
        model = read_sparse(folder / place)
        files = _by_stem(folder / image_folder)
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
        order = {path: i for i, path in enumerate(files.values())}
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(
                folder,
                images,
                cameras,
                masks={
                    n: MaskFiles([folder / "masks" / n / f"{s}.png" for s in stems]) for n in masks
                },
                lenses=lenses,
                cache_mb=self.config.cache_mb,
            ),
            cameras=cameras,
            moments=video_moments([order[p] for p in images], len(files)),
            kinds=masks,
            points=model.points,
            point_colors=model.colors,
            split=split_of(len(images), self.config.test_every),
            world=World.guessed(cameras, metres=False),
            fps=self.config.fps,
            provenance={
                "reader": "reader:colmap",
                "cameras": f"{model.summary}; world in COLMAP's unit",
                **{f"poses of {n}": NO_POSES for n, kind in masks.items() if kind == "human"},
            },
        )


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
