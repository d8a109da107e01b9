"""Limbs whose pose is a guess, frame by frame: the picture hides them, or shows them elsewhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool
from scipy import ndimage

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.body.mask_fit import posed, silhouette

# limb -> landmarks of its middle and its end, body parts beyond the middle
LIMBS = {
    "left arm": ((13, 15), (6, 8)),
    "right arm": ((14, 16), (7, 9)),
    "left leg": ((25, 27), (12, 14)),
    "right leg": ((26, 28), (13, 15)),
}
# On three cameras of benchmarks/real.py, these two find 40 of the 51 wrists that are more than
# 150 mm off about the shoulders; limbs that they leave are 54 mm off, median, the others 158.
SEEN = 0.3  # visibility: a landmark below it was not seen, it was made up
SHARE = 0.8  # of a limb as it is drawn, that lies in the masks of what moves
WIDTH, NEAR = 320, 3  # pixels: of the images in which this is looked at, and from a mask


def guessed_limbs(
    body: BodyModel,
    poses: BodyPose,
    landmarks: Landmarks,
    cameras: list[Camera],
    moving: Callable[[int], Bool[np.ndarray, "H W"]],
) -> dict[str, list[int]]:
    """Of each limb, the frames in which nothing vouches for its pose.

    Args:
        poses: batched over the frames. landmarks: NaN in frames that were not believed.
        moving: pixels of a frame that show people or objects; none: nothing is known there.
    """
    size = torch.tensor([cameras[0].width, cameras[0].height])
    at = landmarks.image[..., :2]
    seen = (landmarks.image[..., 2] >= SEEN) & ((at >= 0) & (at < size)).all(-1)
    hidden = {limb: ~seen[:, list(marks)].all(1) for limb, (marks, _) in LIMBS.items()}
    of_faces = body.vertex_parts[body.faces]
    faces = {
        limb: body.faces[torch.isin(of_faces, torch.tensor(parts)).all(1)]
        for limb, (_, parts) in LIMBS.items()
    }
    step = max(1, cameras[0].width // WIDTH)
    for i, (vertices, _) in enumerate(posed(body, poses)):
        shown = moving(i)[::step, ::step]
        if not shown.any():
            continue
        near = ndimage.binary_dilation(shown, iterations=NEAR)
        camera = cameras[i].resized(shown.shape[1], shown.shape[0])
        for limb, rows in hidden.items():
            drawn = silhouette(vertices, faces[limb], camera)
            rows[i] |= bool((drawn & near).sum() < SHARE * drawn.sum())
    return {limb: rows.nonzero()[:, 0].tolist() for limb, rows in hidden.items()}
