"""A small video of known pixels and the evidence that belongs to it, for the video estimators."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from hoigs.core.interfaces.estimator import EntityRequest, VideoRequest

FRAMES, WIDTH, HEIGHT = 5, 32, 24
ENTITIES = (EntityRequest("human", "human"), EntityRequest("object", "object"))


def frame(i: int) -> np.ndarray:
    """RGB noise, another each frame, with a bright square that moves to the right."""
    image = np.random.default_rng(i).integers(0, 60, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[8:16, 3 * i : 3 * i + 8] = (220, 180, 40)
    return image


def mask(name: str, i: int) -> np.ndarray:
    """The human is the moving square, the object a column beside it."""
    found = np.zeros((HEIGHT, WIDTH), bool)
    start = 3 * i if name == "human" else 3 * i + 9
    found[8:16, start : start + (8 if name == "human" else 3)] = True
    return found


def labels(i: int) -> np.ndarray:
    """1 for the human, 2 for the object."""
    return (mask("human", i) + 2 * mask("object", i)).astype(np.uint8)


def metric(i: int) -> np.ndarray:
    """Metres, 2 in front of a floor that recedes, farther by a decimetre each frame."""
    rows = np.linspace(8, 3, HEIGHT)[:, None] + 0.1 * i
    return np.where(mask("human", i), 2.0, np.broadcast_to(rows, (HEIGHT, WIDTH))).astype("f4")


def request(folder: Path, **changes) -> VideoRequest:
    """The video, with both entities requested."""
    video = VideoRequest(
        FRAMES, WIDTH, HEIGHT, frame, folder, folder / "work", entities=ENTITIES, fps=10.0
    )
    return replace(video, **changes)


def write_masks(folder: Path, draw, *, name="{:05d}.png", mode: str = "L", first: int = 0) -> Path:
    """One image a frame; `draw(i)` gives bool, or numbers as they are to stand in the file."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(FRAMES):
        values = draw(i)
        image = Image.fromarray(values.astype(np.uint8) * (255 if values.dtype == bool else 1))
        if mode == "P":
            image = Image.fromarray(values.astype(np.uint8), mode="L").convert("P")
            image.putdata(values.astype(np.uint8).ravel().tolist())
            image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
        image.save(folder / name.format(i + first))
    return folder
