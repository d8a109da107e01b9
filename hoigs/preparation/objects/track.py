"""Where an object is, frame by frame, when only its mask and the hands are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.maths.frame_times import fill_gaps, smooth
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.masks.mask_stack import MaskStack, Outlines, long_axis, outlines_of
from hoigs.preparation.objects.shape import inflated_outline
from hoigs.preparation.video.source import SourceError

# An object keeps its size but shows other sides; a wrist fitted to one view is off by as much as
# an arm may point towards the camera. The hands give the level, the size most of the change.
SIZE_WEIGHT = 0.75
SMOOTHING = 15  # frames


def held_object(
    masks: MaskStack,
    cameras: Sequence[Camera],
    wrists: Float[Tensor, "F 2 3"] | None,
    count: int,
    depths: Float[np.ndarray, " F"] | None = None,
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float]:
    """A held object: its mask's centroid at the hands' depth, its outline inflated to a shape.

    Of its rotation only the roll in the image is observable this way; the turning about other
    axes is left to training.

    Args:
        masks: of the object. wrists: left and right, world, metres; None: nobody is there.
        count: of points, about. depths: of the object, supposed, where nobody is there.

    Returns:
        the track (grey: colours are sampled afterwards), the points' outward normals, and the
        spread of the object's apparent over its expected size.
    """
    outlines = outlines_of(masks)
    by = "the nearest wrist"
    if wrists is not None:
        depths = hand_depths(masks, cameras, wrists)
    assert depths is not None  # one of both is given
    if wrists is None:
        by = "a supposed size"
    depths = _depths(outlines, depths)
    pixels = torch.from_numpy(outlines.centers).float()
    translations = torch.stack(
        [c.unproject(p, torch.tensor(float(d))) for c, p, d in zip(cameras, pixels, depths)]
    )
    # the largest mask that the border does not cut; a cut one only if it is twice as large
    best = int((outlines.areas * np.where(outlines.whole, 1.0, 0.5)).argmax())
    rest, normals = inflated_outline(masks[best], cameras[best], float(depths[best]), count)
    to_world = cameras[best].world_to_camera[:3, :3].mT
    rest = (rest - cameras[best].to_camera(translations[best])) @ to_world.mT
    rotations = _rolls(rest, translations, outlines, cameras)
    size, spread = apparent_size(rest, rotations, translations, masks, outlines, cameras)
    track = ObjectTrack(
        points=rest * size,
        colors=torch.full_like(rest, 0.5),
        rotations=rotations,
        translations=translations,
        observed=torch.from_numpy(outlines.observed),
        provenance=(
            f"mask centroid; depth from {by} and the outline's length; of the "
            f"rotation only the roll in the image; shape from the outline of frame {best}, half "
            "as thick as wide: a weak guess"
        ),
        rotation_known=False,
    )
    return track, normals @ to_world.mT, spread


def hand_depths(
    masks: MaskStack, cameras: Sequence[Camera], wrists: Float[Tensor, "F 2 3"]
) -> Float[np.ndarray, " F"]:
    """Depth of the wrist that is nearest to the object in the image, metres.

    Args:
        wrists: left and right, world, metres.
    """
    depths, known = np.zeros(len(masks)), np.zeros(len(masks), dtype=bool)
    for i, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        xy, depth = camera.project(wrists[i])
        known[i] = bool(mask.any()) and bool((depth > 0).any())
        if known[i]:
            away = _distance_to(mask, xy.numpy())
            away[depth.numpy() <= 0] = np.inf
            depths[i] = float(depth[int(away.argmin())])
    if not known.any():
        raise SourceError("no frame shows the object and a hand in front of the camera")
    return fill_gaps(depths, known)


def _distance_to(
    mask: Bool[np.ndarray, "H W"], xy: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, " N"]:
    """Pixels from each position, which may lie outside the image, to the mask's nearest pixel."""
    rows, columns = np.nonzero(mask & ~ndimage.binary_erosion(mask))
    edge = np.stack((columns, rows), -1) + 0.5
    return np.linalg.norm(xy[:, None] - edge[None], axis=-1).min(1).astype(np.float64)


def _depths(outlines: Outlines, hands: Float[np.ndarray, " F"]) -> Float[np.ndarray, " F"]:
    """Depths of hands, corrected so that the outline's length agrees; metres, smoothed."""
    measured = np.isfinite(outlines.lengths)
    if not measured.any():
        return smooth(hands, SMOOTHING)
    # log of depth by size over depth by hands, up to a constant: the size in metres
    log_ratio = fill_gaps(-np.log(outlines.lengths * hands), measured)
    log_ratio -= np.median(log_ratio[measured])
    return np.exp(smooth(np.log(hands) + SIZE_WEIGHT * log_ratio, SMOOTHING))


def _rolls(
    points: Float[Tensor, "P 3"],
    translations: Float[Tensor, "F 3"],
    outlines: Outlines,
    cameras: Sequence[Camera],
) -> Float[Tensor, "F 3 3"]:
    """Rotations about the viewing axis that lay the points' long axis along the mask's."""
    known = np.isfinite(outlines.angles)
    rolls = np.zeros(len(cameras))
    for i in np.flatnonzero(known).tolist():
        xy, _ = cameras[i].project(points + translations[i])
        unturned = long_axis(xy.numpy().astype(np.float64))[1]
        known[i] = np.isfinite(unturned)
        rolls[i] = outlines.angles[i] - unturned
    if not known.any():
        return torch.eye(3).expand(len(cameras), 3, 3).clone()
    # an axis has no sign: steps of pi mean nothing
    steady = np.unwrap(rolls[known], period=np.pi)
    steady -= np.pi * np.round(np.median(steady) / np.pi)
    rolls[known] = steady
    rolls = smooth(fill_gaps(rolls, known))
    axes = torch.stack([c.world_to_camera[2, :3] for c in cameras])
    return axis_angle_to_matrices(axes * torch.from_numpy(rolls).float()[:, None])


def apparent_size(
    points: Float[Tensor, "P 3"],
    rotations: Float[Tensor, "F 3 3"],
    translations: Float[Tensor, "F 3"],
    masks: MaskStack,
    outlines: Outlines,
    cameras: Sequence[Camera],
) -> tuple[float, float]:
    """S = median of sqrt(A_mask / A_projected) over frames, and its relative spread.

    Box areas in pixels (HOIGS, object initialisation; the paper takes the mean). Frames in which
    the mask is cut by the image's border or smaller than half the median do not count.
    """
    enough = 0.5 * np.median(outlines.areas[outlines.observed])
    ratios = []
    for i in np.flatnonzero(outlines.whole & (outlines.areas >= enough)).tolist():
        xy, depth = cameras[i].project(points @ rotations[i].mT + translations[i])
        if (depth <= 0).any():
            continue
        projected = np.prod((xy.max(0).values - xy.min(0).values).numpy())
        rows, columns = np.nonzero(masks[i])
        ratios.append(np.sqrt((np.ptp(rows) + 1) * (np.ptp(columns) + 1) / projected))
    if not ratios:
        return 1.0, 0.0
    return float(np.median(ratios)), float(np.std(ratios) / np.median(ratios))
