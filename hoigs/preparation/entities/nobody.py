"""A clip of objects alone: what the person would have given, supposed instead and named so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.series import fill_gaps, smooth
from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.outlines import outlines_of

SIZE = 0.3  # metres across, of an object whose size nothing shows
SMOOTHING = 15  # frames
HEIGHT = 0.5  # of the object's distance: how far below a still camera the floor is


@dataclass(frozen=True)
class Nobody:
    """The world of a clip without a person.

    Attributes:
        scene_scale: metres a unit of the cameras' own world.
        depths: of the object along the view, metres.
        ground: y of the floor under a camera that stays in one place, if y points down.
    """

    scene_scale: float
    depths: Float[np.ndarray, " F"]
    ground: float
    provenance: str
    warnings: list[str] = field(default_factory=list)

    def distance(self, cameras: Sequence[Camera]) -> float:
        """Median depth of the object, metres."""
        return float(np.median(self.depths))


def nobody(masks: MaskStack | None, track: CameraTrack, size: float | None) -> Nobody:
    """The world whose unit is the object's size.

    Args:
        masks: of the first object; None, or empty: nothing was found.
        size: of the object across, metres; None: it is supposed.
    """
    across, how = (SIZE, "supposed") if size is None else (size, "given")
    seen = outlines_of(masks) if masks is not None and masks.coverage().any() else None
    known = np.zeros(len(track.cameras), bool) if seen is None else seen.observed & seen.whole
    depths = np.ones(len(track.cameras))
    if seen is not None and known.any():
        focal = np.array([float(camera.K[0, 0]) for camera in track.cameras])
        extent = np.sqrt(np.where(known, seen.areas, 1.0) * 4 / np.pi)
        depths = smooth(fill_gaps(focal * across / extent, known), SMOOTHING)
        if track.static:  # sides that are seen one after another are larger and smaller
            depths = np.full_like(depths, np.median(depths))
    scale = 1.0
    if not track.metric and masks is not None and known.any():
        scale = float(np.median(depths)) / _own_depth(masks, track)
    text = (
        f"nobody: --person none; the object is {how} to be {across:g} m across, which sets the "
        "unit of the world"
    )
    warnings = [] if size is not None else [
        f"nobody is in the clip, so nothing shows its scale: the object is taken to be {SIZE:g} m "
        "across (--set object_size=0.2, if it is), and all distances follow"
    ]  # fmt: skip
    return Nobody(scale, depths, HEIGHT * float(np.median(depths)), text, warnings)


def _own_depth(masks: MaskStack, track: CameraTrack) -> float:
    """How far off the object is in the unit of cameras that measured points: the median depth of
    the points in its masks, or else of all."""
    inside: list[Tensor] = []
    everywhere: list[Tensor] = []
    for mask, camera in zip(masks, track.cameras, strict=True):
        xy, depth = camera.project(track.points)
        seen = camera.shows(xy, depth)
        column, row = xy[seen].long().unbind(-1)
        everywhere.append(depth[seen])
        inside.append(depth[seen][torch.from_numpy(mask)[row, column]])
    chosen = torch.cat(inside)
    return float((chosen if len(chosen) else torch.cat(everywhere)).median())
