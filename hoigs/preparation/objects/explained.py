"""How well an object's track explains the frames: masks, and colours that it was not given."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.shape import ColorSampler

COLOR_FRAMES = 24  # a median over more changes nothing visible
JUDGED = 12  # frames that are held back
MISSED = 0.3  # difference of colours where only one of mask and outline is


def silhouette_ious(track: ObjectTrack, filmed: Filmed) -> Float[np.ndarray, " F"]:
    """Of each frame, intersection over union of the mask and the outline of the track's points,
    without the pixels of people and other objects; NaN where it is not seen. A pixel counts as soon
    as a point lies in it, which costs an outline of 20 pixels a tenth."""
    masks, hiding = filmed.masks, filmed.hiding()
    found = np.full(len(masks), np.nan)
    for i in track.observed.nonzero().flatten().tolist():
        drawn = _drawn(track, i, filmed.cameras[i]) & ~hiding[i]
        union = int((drawn | masks[i]).sum())
        found[i] = (drawn & masks[i]).sum() / union if union else np.nan
    return found


def outline_errors(track: ObjectTrack, filmed: Filmed) -> Float[np.ndarray, " F"]:
    """Of each frame, metres between the outlines of the mask and of the track's points, on average:
    the area between them by the length of the mask's rim; NaN where it is not seen."""
    masks, hiding = filmed.masks, filmed.hiding()
    found = np.full(len(masks), np.nan)
    for i in track.observed.nonzero().flatten().tolist():
        camera, mask = filmed.cameras[i], masks[i]
        drawn = _drawn(track, i, camera) & ~hiding[i]
        rim = int((mask & ~ndimage.binary_erosion(mask)).sum())
        depth = float((track.translations[i] - camera.center).norm())
        found[i] = (drawn ^ mask).sum() / max(rim, 1) * depth / float(camera.K[0, 0])
    return found


def colors_of(
    track: ObjectTrack,
    normals: Float[Tensor, "P 3"],
    filmed: Filmed,
    without: frozenset[int] = frozenset(),
) -> Float[Tensor, "P 3"]:
    """Of the points, from frames across the video.

    Args:
        without: frames that are not read.
    """
    sampler = ColorSampler(track.points, normals)
    seen = [i for i in np.flatnonzero(track.observed.numpy()) if i not in without]
    chosen = {seen[k] for k in np.linspace(0, len(seen) - 1, COLOR_FRAMES).round().astype(int)}
    for i, image in enumerate(filmed.images()):
        if i in chosen:
            sampler.add(
                image, filmed.masks[i], filmed.cameras[i], track.rotations[i], track.translations[i]
            )
    return sampler.colors()


def held_back_error(track: ObjectTrack, normals: Float[Tensor, "P 3"], filmed: Filmed) -> float:
    """The mean difference of colours, 0 to 1, between frames and what the track draws there with
    the colours of other frames, over the mask and the drawn outline together."""
    seen = np.flatnonzero(track.observed.numpy())
    picks = np.linspace(0, len(seen) - 1, 2 * JUDGED + 1)[1::2].round().astype(int)
    judged = frozenset(seen[picks].tolist())
    colors = colors_of(track, normals, filmed, judged if len(judged) < len(seen) else frozenset())
    hiding, found = filmed.hiding(), []
    for i, image in enumerate(filmed.images()):
        if i in judged:
            drawn = _drawn(track, i, filmed.cameras[i]) & ~hiding[i]
            mask, both = filmed.masks[i], drawn & filmed.masks[i]
            off = np.full(mask.shape, MISSED)
            picture = _painted(track, colors, normals, i, filmed.cameras[i])
            off[both] = np.abs(picture[both] - image[both] / 255).mean(-1)
            found.append(float(off[drawn | mask].mean()))
    return float(np.mean(found))


def _painted(
    track: ObjectTrack,
    colors: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    frame: int,
    camera: Camera,
) -> Float[np.ndarray, "H W 3"]:
    """Every pixel with the colour of the nearest point that faces the camera."""
    world = track.points @ track.rotations[frame].mT + track.translations[frame]
    facing = ((normals @ track.rotations[frame].mT) * (camera.center - world)).sum(-1) > 0
    xy, depth = camera.project(world)
    shown = facing & camera.shows(xy, depth)
    column, row = xy[shown].long().T.numpy()
    picture, empty = (
        np.zeros((camera.height, camera.width, 3)),
        np.ones((camera.height, camera.width), bool),
    )
    picture[row, column], empty[row, column] = colors[shown].numpy(), False
    if empty.all():
        return picture
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return picture[tuple(nearest)]


def _drawn(track: ObjectTrack, frame: int, camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Pixels within the points' outline: the pixels of points, and the gaps between them."""
    world = track.points @ track.rotations[frame].mT + track.translations[frame]
    xy, depth = camera.project(world)
    at = xy[camera.shows(xy, depth)].long().numpy()
    drawn = np.zeros((camera.height, camera.width), bool)
    drawn[at[:, 1], at[:, 0]] = True
    if not len(at):
        return drawn
    # half of the points show their side: their spacing in pixels
    spacing = int(np.ceil(np.sqrt(2 * np.prod(np.ptp(at, axis=0) + 1) / len(at)))) + 1
    (x0, y0), (x1, y1) = at.min(0), at.max(0) + 1
    part = np.pad(drawn[y0:y1, x0:x1], spacing)
    part = ndimage.binary_closing(part, iterations=spacing)
    drawn[y0:y1, x0:x1] = ndimage.binary_fill_holes(part)[spacing:-spacing, spacing:-spacing]
    return drawn
