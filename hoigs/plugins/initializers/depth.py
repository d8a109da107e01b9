"""initializer:depth: the object's masked depth, back-projected and carried into the object's frame.

HOIGS takes an object's place from its masked depth (Sec. "Object Initialization"); here the same
depth also gives the points.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.initializer import ObjectInitializer, training_frames
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.plugins.initializers.alignment import inliers, moving_part, require_metric_depth


class DepthInitializerConfig(ComponentConfig):
    """Settings of `initializer:depth`."""

    frames: int | list[int] = Field(
        default=16,
        description="number of training frames, of those that see most of the object; or a list",
    )
    count: int = Field(default=20_000, ge=4, description="largest number of points")
    erode: int = Field(
        default=1, ge=0, description="pixels removed at the mask's edge, where depths mix"
    )
    edge: float = Field(
        default=0.05, gt=0, description="largest step of depth to a neighbour pixel, as a share"
    )
    neighbours: int = Field(
        default=16, ge=1, description="neighbours of a point in the outlier test"
    )
    outliers: float = Field(
        default=2.5,
        gt=1,
        description="largest distance of a point from its neighbours, in multiples of theirs from "
        "their own",
    )


class DepthInitializer(ObjectInitializer):
    """Points under the object's mask at their measured depth, from one frame or several.

    The clip's track carries each frame's points into the object's frame, so that several frames
    show several sides; with frames=1 nothing is known of the far side. Pixels without depth, at
    the mask's edge or at a step of the depth do not count, and outliers are removed.
    """

    Config: ClassVar = DepthInitializerConfig
    config: DepthInitializerConfig

    def __init__(self, config: DepthInitializerConfig | None = None, *, seed: int = 0) -> None:
        super().__init__(config)
        self.seed = seed

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(config, seed=context.seed)

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        """See ObjectInitializer.

        Raises:
            ValueError: no track, no metric depth, or none under the mask in the chosen frames.
        """
        require_metric_depth(clip)
        track = clip.objects.get(entity)
        if track is None:
            raise ValueError(f"the clip has no track of {entity} to carry its points along")
        chosen = self._frames(clip, entity, track)
        parts = [self._points(clip, entity, track, i) for i in chosen]
        points, colors = (torch.cat([part[k] for part in parts]) for k in (0, 1))
        if len(points) == 0:
            raise ValueError(
                f"no depth is known under the mask of {entity} in frames {chosen}; choose other "
                "`frames`, or a smaller `erode` for a thin object"
            )
        generator = torch.Generator().manual_seed(self.seed)
        rows = torch.randperm(len(points), generator=generator)[: self.config.count].sort().values
        points, colors = points[rows], colors[rows]
        kept = inliers(points, self.config.neighbours, self.config.outliers)
        return replace(
            track,
            points=points[kept],
            colors=colors[kept],
            moving=moving_part(track, points[kept]),
            provenance=f"masked depth of frames {chosen}; poses: {track.provenance}",
        )

    def _frames(self, clip: Clip, entity: str, track: ObjectTrack) -> list[int]:
        if isinstance(self.config.frames, list):
            absent = [i for i in self.config.frames if not 0 <= i < len(clip)]
            if absent or not self.config.frames:
                raise ValueError(
                    f"frames {self.config.frames}: expected some of 0 to {len(clip) - 1}"
                )
            return sorted(set(self.config.frames))
        candidates = [i for i in training_frames(clip) if track.observed[i]]
        areas = torch.tensor([int(clip.store.mask(entity, i).sum()) for i in candidates])
        if not bool((areas > 0).any()):
            raise ValueError(f"the mask of {entity} is empty in every observed training frame")
        large = areas >= 0.5 * areas[areas > 0].median()  # the others are mostly hidden
        candidates = [i for i, good in zip(candidates, large.tolist(), strict=True) if good]
        at = torch.linspace(0, len(candidates) - 1, min(self.config.frames, len(candidates)))
        return [candidates[i] for i in at.round().long().tolist()]

    def _points(
        self, clip: Clip, entity: str, track: ObjectTrack, at: int
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        frame = clip[at]
        assert frame.depth is not None  # metric depth is there in every frame
        good = frame.masks[entity] & steady(frame.depth, self.config.edge)
        good &= shrunk(frame.masks[entity], self.config.erode)
        if frame.ignored is not None:
            good &= ~frame.ignored
        world = frame.camera.unproject(frame.camera.pixel_grid()[good], frame.depth[good])
        inside = (world - track.translations[at]) @ track.rotations[at]
        return inside, frame.rgb[good]


def steady(depth: Float[Tensor, "H W"], edge: float) -> Bool[Tensor, "H W"]:
    """Pixels of known depth whose known neighbours, up, down, left and right, are about as deep.

    Args:
        depth: metres; 0, negative, NaN or infinite where unknown.
        edge: largest step to a neighbour, as a share of the depth.
    """
    known = torch.isfinite(depth) & (depth > 0)
    clean = torch.where(known, depth, torch.zeros_like(depth))
    good = known.clone()
    for axis in (0, 1):
        step = clean.diff(dim=axis).abs()
        length = depth.shape[axis] - 1
        both = known.narrow(axis, 0, length) & known.narrow(axis, 1, length)
        near = torch.minimum(clean.narrow(axis, 0, length), clean.narrow(axis, 1, length))
        jump = both & (step > edge * near)
        good.narrow(axis, 0, length).logical_and_(~jump)
        good.narrow(axis, 1, length).logical_and_(~jump)
    return good


def shrunk(mask: Bool[Tensor, "H W"], pixels: int) -> Bool[Tensor, "H W"]:
    """A mask without its outermost pixels; the image's border is no edge of the object."""
    if pixels == 0:
        return mask
    outside = (~mask).float()[None, None]
    size = 2 * pixels + 1
    grown = torch.nn.functional.max_pool2d(outside, size, stride=1, padding=pixels)
    return grown[0, 0] < 0.5
