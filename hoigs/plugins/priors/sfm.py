"""prior:sfm: the clip's scene points that lie on the object; for things that stand still.

What structure from motion finds on an object is part of the scene's points: it stood still while
the camera went about it, or turned on a table with a background that shows nothing (methods A.11,
`object_init: sfm`; E.19 for why it fails on what moves).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.clip import Clip, ObjectTrack
from hoigs.core.config import ComponentConfig
from hoigs.core.prior import ObjectPrior, training_frames
from hoigs.plugins.priors.alignment import moving_part
from hoigs.plugins.priors.depth import shrunk


class SfmPriorConfig(ComponentConfig):
    """Settings of `prior:sfm`."""

    share: float = Field(
        default=0.8, gt=0, le=1, description="of the frames that see a point, in its mask"
    )
    min_frames: int = Field(default=3, ge=1, description="that see a point at least")
    min_points: int = Field(default=20, ge=4, description="to call it an object")
    dilate: int = Field(default=1, ge=0, description="pixels that masks grow; rims are half lost")
    occlusion: float = Field(
        default=0.05, gt=0, description="a point this much behind the depth map, as a share, is "
        "hidden there and does not count; used where the clip has metric depth"
    )  # fmt: skip
    max_motion: float = Field(
        default=0.05, ge=0, description="metres that the track may move the points over the clip"
    )


class SfmPrior(ObjectPrior):
    """Scene points that project into the object's mask in most frames that see them.

    A rigid object that stands still in the clip's world. The poses stay the track's.

    Args: as SfmPriorConfig describes them.
    """

    def __init__(
        self,
        share: float = 0.8,
        min_frames: int = 3,
        min_points: int = 20,
        dilate: int = 1,
        occlusion: float = 0.05,
        max_motion: float = 0.05,
    ) -> None:
        self.share, self.min_frames, self.min_points = share, min_frames, min_points
        self.dilate, self.occlusion, self.max_motion = dilate, occlusion, max_motion

    def initialise(self, clip: Clip, entity: str) -> ObjectTrack:
        """See ObjectPrior.

        Raises:
            ValueError: no track, too few scene points on the object, or it moves.
        """
        track = clip.objects.get(entity)
        if track is None:
            raise ValueError(f"the clip has no track of {entity}: its frame is open")
        seen, inside = self._votes(clip, entity)
        kept = (seen >= self.min_frames) & (inside >= self.share * seen)
        if int(kept.sum()) < self.min_points:
            raise ValueError(
                f"{int(kept.sum())} of the clip's {len(clip.points)} scene points lie on {entity} "
                f"in {self.share:.0%} of the frames that see them; {self.min_points} are needed. "
                "Structure from motion sees no points on what moves or shines: use prior:depth"
            )
        frames = [i for i in training_frames(clip) if track.observed[i]] or training_frames(clip)
        at = frames[len(frames) // 2]
        points = (clip.points[kept] - track.translations[at]) @ track.rotations[at]
        motion = _motion(points, track, frames)
        if motion > self.max_motion:
            raise ValueError(
                f"{entity} moves by {motion:.2f} m, and scene points stand still; use prior:depth, "
                f"or raise max_motion ({self.max_motion} m) if it is the track that errs"
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
                continue  # out of sight: nobody knows where it is
            mask = ~shrunk(~mask, self.dilate)
            xy, depth = camera.project(clip.points)
            column, row = xy.floor().long().unbind(-1)
            there = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            there &= depth > 0
            rows = there.nonzero().squeeze(1)
            if clip.depth_kind == "metric":
                surface = clip.store.depth(i)
                assert surface is not None
                front = surface[row[rows], column[rows]]
                rows = rows[(front <= 0) | (depth[rows] <= (1 + self.occlusion) * front)]
            seen[rows] += 1
            inside[rows] += mask[row[rows], column[rows]].float()
        return seen, inside


def _motion(points: Float[Tensor, "P 3"], track: ObjectTrack, frames: list[int]) -> float:
    """Median over the points of the largest way between two frames' places, metres."""
    few = points[:: -(-len(points) // 500)]
    world = few @ track.rotations[frames].mT + track.translations[frames, None]
    reach = world.amax(0) - world.amin(0)
    return float(reach.norm(dim=-1).median())
