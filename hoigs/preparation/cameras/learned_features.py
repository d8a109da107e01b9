"""Features that a network finds, for videos in which SIFT finds too few: blurred, faint, small.

XFeat (Potje et al., CVPR 2024) places features to a pixel, where SIFT places them to a tenth of
one; so they serve when SIFT has failed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from hoigs.core.system.xfeat import ENVIRONMENT, load_xfeat
from hoigs.preparation.cameras.turning_cameras import grown
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.video.frames import Frames

MOST = 1024  # features of an image, the surest
ALIKE = 0.82  # cosine of matched descriptors, as the authors have it
NEXT = 5  # frames that each is matched with, and as those at distances 8, 16, 32 and 64
FEWEST = 15  # matches of a pair

Positions = Float[np.ndarray, "N 2"]
Extractor = Callable[[UInt8[np.ndarray, "H W 3"]], tuple[Positions, Float[np.ndarray, "N C"]]]


def installed() -> Extractor | None:
    """XFeat: positions in pixels, the first pixel's middle at 0.5, and unit descriptors of 64
    numbers, the surest first. None: its weights are not installed."""
    if not ENVIRONMENT.installed:
        return None
    network = load_xfeat()

    def extract(image: UInt8[np.ndarray, "H W 3"]) -> tuple[Positions, Float[np.ndarray, "N 64"]]:
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        found = network.detectAndCompute(pixels, top_k=2 * MOST)[0]
        return found["keypoints"].numpy() + 0.5, found["descriptors"].numpy()

    return extract


def write_matches(
    pycolmap: Any,
    database: Path,
    video: Frames,
    masks: GivenMasks,
    extract: Extractor,
    progress: Callable[[float], None],
) -> None:
    """Replaces the features and matches of a database of `video`'s frames, named by number.

    The matches are not verified: `verify` does so.
    """
    found = []
    for i, image in enumerate(video):
        xy, descriptors = extract(image)
        column, row = xy.astype(int).T
        seen = ~grown(masks.moving(i))[row, column]
        found.append((xy[seen][:MOST], descriptors[seen][:MOST]))
        progress(0.6 * (i + 1) / len(video))
    database_ = pycolmap.Database.open(database)
    try:
        for clear in ("descriptors", "keypoints", "matches", "two_view_geometries"):
            getattr(database_, f"clear_{clear}")()
        ids = {Path(image.name).stem: image.image_id for image in database_.read_all_images()}
        order = [ids[f"{number:05d}"] for number in video.indices]
        for number, (xy, _) in zip(order, found, strict=True):
            database_.write_keypoints(number, xy.astype(np.float32))
        for one, two in _pairs(len(video)):
            rows = mutual(found[one][1], found[two][1])
            if len(rows) >= FEWEST:
                database_.write_matches(order[one], order[two], rows.astype(np.uint32))
            progress(0.6 + 0.4 * (one + 1) / len(video))
    finally:
        database_.close()


def verify(pycolmap: Any, database: Path, video: Frames) -> None:
    """Keeps what two views of a still scene allow, for the database's focal length."""
    names = [f"{number:05d}.png" for number in video.indices]
    listed = database.with_suffix(".pairs.txt")
    listed.write_text("\n".join(f"{names[i]} {names[j]}" for i, j in _pairs(len(names))))
    pycolmap.verify_matches(database, listed)


def mutual(one: Float[np.ndarray, "N C"], two: Float[np.ndarray, "M C"]) -> Int[np.ndarray, "P 2"]:
    """Pairs of rows that are each other's nearest neighbour and alike."""
    if not len(one) or not len(two):
        return np.zeros((0, 2), int)
    alike = one @ two.T
    best = alike.argmax(1)
    rows = np.arange(len(one))
    kept = (alike.argmax(0)[best] == rows) & (alike[rows, best] > ALIKE)
    return np.stack((rows[kept], best[kept]), 1)


def _pairs(count: int) -> Iterator[tuple[int, int]]:
    for i in range(count):
        for step in (*range(1, NEXT + 1), 8, 16, 32, 64):
            if i + step < count:
                yield i, i + step
