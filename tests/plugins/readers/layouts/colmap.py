"""A clip as a plain COLMAP folder: images/, sparse/0/, masks/ENTITY/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from layouts.colmap_text import write_model
from layouts.common import save_image, save_mask

from hoigs.core.values.clip import Clip


def write(clip: Clip, folder: Path, *, binary: bool = False, place: str = "sparse/0",
          masks: bool = True, **model: Any) -> None:  # fmt: skip
    names = [f"frame_{i + 1}.png" for i in range(len(clip))]  # unpadded, as ffmpeg's %d gives
    write_model(folder / place, clip.cameras, names, clip.points, clip.point_colors, **model)
    if binary:
        to_binary(folder / place)
    for name, frame in zip(names, clip):
        save_image(folder / "images" / name, frame.image)
        for entity, mask in frame.masks.items() if masks else ():
            save_mask(folder / "masks" / entity / name, mask)


def to_binary(folder: Path) -> None:
    """By COLMAP itself."""
    import pycolmap

    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()
