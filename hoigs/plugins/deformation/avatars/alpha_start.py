"""Where the learnable scale alpha of HOIGS, Eq. 6, starts: at one, or at a ratio of depths."""

from __future__ import annotations

from typing import Literal

import torch

from hoigs.core.interfaces.body import PELVIS, BodyModel
from hoigs.core.model.object_placement import masked_depths, seen_middle
from hoigs.core.values.clip import BodyTrack, Clip

AlphaStart = Literal["one", "depth"]

FRAMES = 16  # a median over more of them is the same


@torch.no_grad()
def depth_ratio(clip: Clip, entity: str, body: BodyModel, track: BodyTrack) -> float:
    """Median over frames of the clip's depth under a human's mask, divided by that of the front of
    the posed body.

    Masks that touch the border of the image show only a part of the body and are left out, unless
    all do.

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
