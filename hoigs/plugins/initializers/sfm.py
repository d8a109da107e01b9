"""initializer:sfm: the clip's scene points that lie on the object; for objects that stand still.

Structure from motion finds points on an object only where it stands still relative to the rest of
the scene: while the camera moves around it, or on a turntable before a plain background.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.initializer import ObjectInitializer, training_frames
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.plugins.initializers.alignment import moving_part
from hoigs.plugins.initializers.depth import shrunk


class SfmInitializerConfig(ComponentConfig):
    """Settings of `initializer:sfm`."""

    share: float = Field(
        default=0.8,
        gt=0,
        le=1,
        description="least share of the frames that see a point in which it lies in the mask",
    )
    min_frames: int = Field(default=3, ge=1, description="least number of frames that see a point")
    min_points: int = Field(default=20, ge=4, description="least number of points on the object")
    dilate: int = Field(default=1, ge=0, description="pixels by which masks grow")
    occlusion: float = Field(
        default=0.05, gt=0, description="a point this much behind the depth map, as a share, is "
        "hidden there and does not count; used where the clip has metric depth"
    )  # fmt: skip
    max_motion: float = Field(
        default=0.05, ge=0, description="metres that the track may move the points over the clip"
    )


class SfmInitializer(ObjectInitializer):
    """Scene points that project into the object's mask in most frames that see them.

    A rigid object that stands still in the clip's world. The poses stay the track's.
    """

    Config: ClassVar = SfmInitializerConfig
    config: SfmInitializerConfig

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        """See ObjectInitializer.

        Raises:
            ValueError: no track, too few scene points on the object, or it moves.
        """
        track = clip.objects.get(entity)
        if track is None:
            raise ValueError(f"the clip has no track of {entity}, which defines its frame")
        seen, inside = self._votes(clip, entity)
        kept = (seen >= self.config.min_frames) & (inside >= self.config.share * seen)
        if int(kept.sum()) < self.config.min_points:
            raise ValueError(
                f"{int(kept.sum())} of the clip's {len(clip.points)} scene points lie on {entity} "
                f"in {self.config.share:.0%} of the frames that see them; {self.config.min_points} "
                "are needed. Structure from motion finds no points on what moves or is shiny: use "
                "initializer:depth"
            )
        frames = [i for i in training_frames(clip) if track.observed[i]] or training_frames(clip)
        at = frames[len(frames) // 2]
        points = (clip.points[kept] - track.translations[at]) @ track.rotations[at]
        motion = _motion(points, track, frames)
        if motion > self.config.max_motion:
            raise ValueError(
                f"{entity} moves by {motion:.2f} m, but scene points must stand still; use "
                f"initializer:depth, or raise max_motion ({self.config.max_motion} m) if the track "
                "is wrong"
            )
        return replace(
            track,
            points=points,
            colors=clip.point_colors[kept],
            moving=moving_part(track, points),
            provenance=f"scene points within its mask; poses: {track.provenance}",
        )

    def _votes(self, clip: Clip, entity: str) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Frames that see each scene point, and those in whose mask it lies."""
        seen, inside = torch.zeros(len(clip.points)), torch.zeros(len(clip.points))
        for i in training_frames(clip):
            mask, camera = clip.store.mask(entity, i), clip.cameras[i]
            if not mask.any():
                continue  # not seen in this frame: its place is interpolated
            mask = ~shrunk(~mask, self.config.dilate)
            xy, depth = camera.project(clip.points)
            column, row = xy.floor().long().unbind(-1)
            rows = camera.shows(xy, depth).nonzero().squeeze(1)
            if clip.depth_kind == "metric":
                surface = clip.store.depth(i)
                assert surface is not None
                front = surface[row[rows], column[rows]]
                rows = rows[(front <= 0) | (depth[rows] <= (1 + self.config.occlusion) * front)]
            seen[rows] += 1
            inside[rows] += mask[row[rows], column[rows]].float()
        return seen, inside


def _motion(points: Float[Tensor, "P 3"], track: ObjectTrack, frames: list[int]) -> float:
    """Median over the points of the largest distance between their places in two frames, metres."""
    few = points[:: -(-len(points) // 500)]
    world = few @ track.rotations[frames].mT + track.translations[frames, None]
    reach = world.amax(0) - world.amin(0)
    return float(reach.norm(dim=-1).median())
