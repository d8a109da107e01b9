"""A clip as a DAVIS sequence: JPEGImages/ and Annotations/."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from layouts.common import save_image, save_mask
from PIL import Image

from hoigs.core.values.clip import Clip

IDS = {"human": 1, "object": 2}


def write(clip: Clip, root: Path, *, folders: bool = False, resolution: str = "480p") -> Path:
    """The sequence's folder in JPEGImages.

    Args:
        folders: DreamScene4D's annotations, a folder of binary masks an object, and no resolution
            in the path; else DAVIS's palette images.
    """
    place = Path("juggle") if folders else Path(resolution, "juggle")
    images, notes = root / "JPEGImages" / place, root / "Annotations" / place
    for i, frame in enumerate(clip):
        save_image(images / f"{i:05d}.png", frame.image)
        ids = np.zeros(frame.image.shape[:2], np.uint8)
        for name, number in IDS.items():
            ids[frame.masks[name].numpy()] = number
            if folders:
                save_mask(notes / f"{number:03d}" / f"{i:05d}.png", frame.masks[name])
        if not folders:
            ids[0, 0] = 255  # DAVIS's void
            picture = Image.fromarray(ids, mode="P")
            picture.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, *[0] * 759])
            notes.mkdir(parents=True, exist_ok=True)
            picture.save(notes / f"{i:05d}.png")
    return images
