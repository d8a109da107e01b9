"""Scene points in metres: COLMAP's without the people, or a supposed floor and wall."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.preparation.entities.entity_masks import EntityMasks
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.scene.background_points import (
    PLATE_FRAMES,
    background_plate,
    plate_points,
)
from hoigs.preparation.scene.dense_points import densify, keyframes
from hoigs.preparation.scene.depth import median_depth
from hoigs.preparation.scene.plate_view import PlateView
from hoigs.preparation.video.source import SourceError


@dataclass(frozen=True)
class ScenePoints:
    """Points in the world, metres, RGB in [0, 1], and what they were made from."""

    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    provenance: str


def camera_scene(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    masks: EntityMasks,
    cameras: Sequence[Camera],
    images: Images,
    count: int,
) -> ScenePoints:
    """The points that came with the cameras but for those on the person or the object, and more
    between them.

    A point goes if, of the frames that see its place, at least half see it inside a mask.

    Args:
        masks: of the frames. images: gives the frames anew.
        count: of points, about: the gaps are filled up to it (`dense_points.densify`).
    """
    inside = torch.zeros(len(points))
    visible = torch.zeros(len(points))
    for i, camera in enumerate(cameras):
        xy, depth = camera.project(points)
        seen = camera.shows(xy, depth)
        column, row = xy[seen].long().unbind(-1)
        moving = torch.from_numpy(masks.moving(i))
        visible += seen
        inside[seen] += moving[row, column]
    keep = inside < 0.5 * visible.clamp_min(1)
    if not keep.any():
        raise SourceError("every scene point lies on the person or the object")
    dropped = f"{int((~keep).sum())} of {len(points)} on the person or object dropped"
    text = f"points that came with the cameras, {dropped}"
    points, colors = points[keep], colors[keep]
    chosen = keyframes(len(cameras))
    shown = {i: image for i, image in enumerate(images()) if i in chosen}
    frames = [(shown[i], masks.moving(i), cameras[i]) for i in chosen]
    more, more_colors = densify(points, frames, max(0, count - len(points)))
    text += f"; {len(more)} more interpolated between them in {len(chosen)} frames"
    return ScenePoints(torch.cat((points, more)), torch.cat((colors, more_colors)), text)


def static_scene(
    images: Images,
    masks: EntityMasks,
    cameras: Sequence[Camera],
    *,
    ground: float,
    distance: float,
    backdrop: float,
    count: int,
    metres: Callable[[int], Float[np.ndarray, "H W"]] | None = None,
) -> ScenePoints:
    """A floor under the feet and a wall behind, coloured by the frames' unmasked pixels.

    Args:
        images: gives the frames anew. masks: of the frames.
        cameras: of the frames, all in the world's origin; they may look into other directions.
        ground: height of the camera over the floor, metres. distance: of the person, metres.
        backdrop: distance of the wall in distances of the person.
        count: of points, about.
        metres: measured depth of a frame, 0 where unknown; None: it is supposed everywhere.
    """
    chosen = set(np.linspace(0, len(cameras) - 1, PLATE_FRAMES).round().astype(int).tolist())
    view = PlateView.of(cameras)
    shown = (
        view.carried(image, masks.moving(i), cameras[i])
        for i, image in enumerate(images())
        if i in chosen
    )
    plate = background_plate(shown, view.margin)
    measured = None
    if metres is not None:
        depths = (
            view.carried_depth(metres(i), masks.moving(i), cameras[i]) for i in sorted(chosen)
        )
        measured = median_depth(depths, (view.camera.width, view.camera.height))
    within = view.within([cameras[i] for i in sorted(chosen)])
    points, colors = plate_points(
        plate, view.camera, ground=ground, backdrop=backdrop * distance, count=count,
        within=within, measured=measured,
    )  # fmt: skip
    floor = (
        f"a level floor {ground:.2f} m below a level camera and a wall at "
        f"{backdrop * distance:.1f} m"
    )
    if measured is None:
        text = f"supposed: {floor}, coloured by the median of unmasked pixels; its depth is not "
        text += "measured, and "
    else:
        share = 100 * float((measured[within] > 0).mean())
        text = f"the median of the depth maps over unmasked pixels, {share:.0f} % of the image "
        text += f"(else {floor}); "
    text += f"{100 * (1 - plate.seen[within].mean()):.1f} % of it is never seen"
    return ScenePoints(points, colors, text)
