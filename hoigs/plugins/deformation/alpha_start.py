"""Where the learnable scale alpha starts: at one, or at what depth says (methods A.4)."""

from __future__ import annotations

from typing import Literal

import torch

from hoigs.core.body import PELVIS, BodyModel
from hoigs.core.clip import BodyTrack, Clip
from hoigs.core.placement import masked_depths, seen_middle

AlphaStart = Literal["one", "depth"]

FRAMES = 16  # a median over more changes nothing


@torch.no_grad()
def depth_ratio(clip: Clip, entity: str, body: BodyModel, track: BodyTrack) -> float:
    """Median over frames of the depth under a human's mask over that of the posed body's front.

    Masks that touch the image's border show a part of the body, so they are left out if others
    remain.

    Raises:
        ValueError: the clip has no metric depth under this human's mask.
    """
    ratios: dict[bool, list[float]] = {True: [], False: []}
    for position in range(0, len(clip), max(1, len(clip) // FRAMES)):
        frame = clip[position]
        mask, view = frame.masks[entity], frame.camera.world_to_camera
        middle, _, known = masked_depths([mask], [frame.depth])
        if not known[0]:
            continue
        posed = body(track.poses.frame(frame.moment.index))
        about = (posed.vertices - posed.joints[PELVIS]) @ view[:3, :3].mT
        front = frame.camera.to_camera(posed.joints[PELVIS])[2] + seen_middle(about)[2]
        cut = bool(mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any())
        if front > 0:
            ratios[cut].append(float(middle[0] / front))
    found = ratios[False] or ratios[True]
    if clip.depth_kind != "metric" or not found:
        raise ValueError(
            f'alpha_start: "depth" needs metric depth under the mask of "{entity}"; this clip\'s '
            f'depth is {clip.depth_kind}; use "one"'
        )
    return float(torch.tensor(found).median())
