"""Where an object is, frame by frame, when only its mask and the hands are known."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import ObjectTrack
from hoigs.preparation.ball import fill_gaps, smooth
from hoigs.preparation.masks import MaskStack
from hoigs.preparation.object_shape import inflated_outline
from hoigs.preparation.source import SourceError


def mask_centers(
    masks: MaskStack,
) -> tuple[Float[np.ndarray, "F 2"], Bool[np.ndarray, " F"]]:
    """Centroid of each mask, pixels, interpolated over empty ones, and which are not empty."""
    centers = np.zeros((len(masks), 2))
    observed = np.zeros(len(masks), dtype=bool)
    for i, mask in enumerate(masks):
        rows, columns = np.nonzero(mask)
        observed[i] = len(rows) > 0
        if observed[i]:
            centers[i] = columns.mean() + 0.5, rows.mean() + 0.5
    if not observed.any():
        raise SourceError("the object's mask is empty in every frame: there is nothing to track")
    return np.stack([fill_gaps(c, observed) for c in centers.T], 1), observed


def hand_depths(
    masks: MaskStack, cameras: list[Camera], wrists: Float[Tensor, "F 2 3"]
) -> Float[np.ndarray, " F"]:
    """Depth of the wrist that is nearest to the object in the image, metres, smoothed.

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
    return smooth(fill_gaps(depths, known))


def _distance_to(
    mask: Bool[np.ndarray, "H W"], xy: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, " N"]:
    """Pixels from each position, which may lie outside the image, to the mask's nearest pixel."""
    rows, columns = np.nonzero(mask & ~ndimage.binary_erosion(mask))
    edge = np.stack((columns, rows), -1) + 0.5
    return np.linalg.norm(xy[:, None] - edge[None], axis=-1).min(1).astype(np.float64)


def held_object(
    masks: MaskStack,
    cameras: list[Camera],
    wrists: Float[Tensor, "F 2 3"],
    count: int,
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float]:
    """A held object: its mask's centroid at the hands' depth, its outline inflated to a shape.

    Rotation is not observable this way: the track keeps the orientation of the frame that shows
    the most of the object, and training has to find the turning.

    Args:
        masks: of the object. wrists: left and right, world, metres. count: of points, about.

    Returns:
        the track (grey: colours are sampled afterwards), the points' outward normals, and the
        spread of the object's apparent over its expected size.
    """
    centers, observed = mask_centers(masks)
    depths = hand_depths(masks, cameras, wrists)
    pixels = torch.from_numpy(centers).float()
    translations = torch.stack(
        [c.unproject(p, torch.tensor(float(d))) for c, p, d in zip(cameras, pixels, depths)]
    )
    best = _best_frame(masks)
    rest, normals = inflated_outline(masks[best], cameras[best], float(depths[best]), count)
    to_world = cameras[best].world_to_camera[:3, :3].mT
    middle = cameras[best].to_camera(translations[best])
    rest = (rest - middle) @ to_world.mT
    size, spread = apparent_size(rest, translations, masks, cameras)
    frames = len(cameras)
    track = ObjectTrack(
        points=rest * size,
        colors=torch.full_like(rest, 0.5),
        rotations=torch.eye(3).expand(frames, 3, 3).clone(),
        translations=translations,
        observed=torch.from_numpy(observed),
        provenance=(
            f"mask centroid at the nearest wrist's depth; no rotation; shape from the outline of "
            f"frame {best}, half as thick as wide: a weak guess"
        ),
    )
    return track, normals @ to_world.mT, spread


def _best_frame(masks: MaskStack) -> int:
    """The frame with the largest mask among those that the image's border does not cut."""
    areas = np.array([m.sum() for m in masks], dtype=float)
    whole = np.array([not _cut_off(m) for m in masks])
    return int(np.where(whole, areas, 0.5 * areas).argmax())


def _cut_off(mask: Bool[np.ndarray, "H W"]) -> bool:
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def apparent_size(
    points: Float[Tensor, "P 3"],
    translations: Float[Tensor, "F 3"],
    masks: MaskStack,
    cameras: list[Camera],
) -> tuple[float, float]:
    """S = median of sqrt(A_mask / A_projected) over frames, and its relative spread.

    Box areas in pixels (HOIGS, object initialisation; the paper takes the mean). Frames in which
    the mask is cut by the image's border or smaller than the median do not count.
    """
    areas = np.array([m.sum() for m in masks])
    ratios = []
    for mask, camera, shift in zip(masks, cameras, translations, strict=True):
        if mask.sum() < max(1, np.median(areas)) or _cut_off(mask):
            continue
        xy, depth = camera.project(points + shift)
        if (depth <= 0).any():
            continue
        projected = np.prod((xy.max(0).values - xy.min(0).values).numpy())
        rows, columns = np.nonzero(mask)
        ratios.append(np.sqrt((np.ptp(rows) + 1) * (np.ptp(columns) + 1) / projected))
    if not ratios:
        return 1.0, 0.0
    return float(np.median(ratios)), float(np.std(ratios) / np.median(ratios))
