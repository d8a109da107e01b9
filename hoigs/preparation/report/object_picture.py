"""object.jpg: the object as it was taken to be, in one frame, so that a wrong choice is seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image
from scipy import ndimage

from hoigs.preparation.report.overlay import OBJECT_COLOR

NAME, LONGEST, DIM = "object.jpg", 960, 0.45


def shown_frame(numbers: Sequence[int], boxes: Sequence[Sequence[float]], prompted: Sequence[int],
                coverage: Sequence[float]) -> int:  # fmt: skip
    """Position among the chosen frames `numbers` of the one to show: where the object was proposed
    or prompted, if its mask is there, else where its mask is largest."""
    for number in [int(box[0]) for box in boxes] + list(prompted):
        nearest = int(np.abs(np.asarray(numbers) - number).argmin())
        if coverage[nearest] > 0:
            return nearest
    return int(np.argmax(coverage))


def save_object_picture(
    folder: Path, image: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]
) -> None:
    """The frame with everything but the object dimmed, and its outline."""
    width = max(1, round(max(image.shape) / 400))
    border = ndimage.binary_dilation(mask, iterations=width) & ~mask
    shown = np.where(mask[..., None], image, (DIM * image).astype(np.uint8))
    shown[border] = OBJECT_COLOR
    picture = Image.fromarray(shown)
    picture.thumbnail((LONGEST, LONGEST))
    picture.save(folder / NAME, quality=88)
