"""The scene in metres: an estimator's depth against what is known, and the scene's points."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.entities.final_masks import EntityMasks
from hoigs.preparation.entities.people import FittedPeople
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.scene.depth import (
    DepthFit,
    DepthSource,
    fit_depth,
    seen_points,
    seen_surface,
)
from hoigs.preparation.scene.scene_points import ScenePoints, camera_scene, static_scene

Metres = Callable[[int], Float[np.ndarray, "H W"]]


def depth_in_metres(
    maps: DepthSource,
    people: FittedPeople,
    body: BodyModel,
    track: CameraTrack,
    cameras: Sequence[Camera],
    masks: EntityMasks,
    advance: Callable[[float], None],
) -> DepthFit:
    """An estimator's depth against the cameras' points and the first person's surface."""
    first = people.first
    surfaces = [] if first is None else [vertices for vertices, _ in first.posed(body)]
    points = track.points * people.world.scene_scale
    return fit_depth(
        maps,
        lambda i: seen_points(points, cameras[i], masks.moving(i)),
        lambda i: seen_surface(
            surfaces[i] if surfaces else torch.zeros(0, 3), cameras[i], masks.human[i]
        ),
        len(cameras),
        advance,
    )


def find_scene(
    people: FittedPeople,
    track: CameraTrack,
    cameras: Sequence[Camera],
    masks: EntityMasks,
    images: Images,
    options: PrepareOptions,
    metres: Metres | None,
) -> ScenePoints:
    """Points of what stands still: those of a moving camera, or on planes and depth.

    Args:
        metres: depth of a frame, 0 where it is unknown; None without an estimator of depth.
    """
    if not track.static:
        points = track.points * people.world.scene_scale
        return camera_scene(points, track.colors, masks, cameras, images, options.scene_points)
    return static_scene(
        images, masks, cameras,
        ground=people.world.ground,
        distance=people.world.distance(cameras),
        backdrop=options.backdrop, count=options.scene_points,
        metres=metres,
    )  # fmt: skip
