"""When an object's state changes (HOSNeRF, Liu et al. 2023), and the frame that each state is
attached to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.maths.frame_times import time_of
from hoigs.core.maths.rotations import matrices_to_quats, normalize_quats, quats_to_matrices
from hoigs.core.values.clip import ObjectTrack

Attach = Literal["nearest", "steadiest"]

STILL = 0.1  # metres a second; a hand that carries something is faster
SHORTEST = 0.2  # seconds; a shorter state is noise


@dataclass(frozen=True)
class Frames:
    """A moving coordinate frame, over F frames of a clip: local to world."""

    rotations: Float[Tensor, "F 3 3"]
    origins: Float[Tensor, "F 3"]


@dataclass(frozen=True)
class Attachment:
    """An object fixed in a moving frame.

    Attributes:
        bone: name of that frame. quat, place: the object there, wxyz and metres.
        spread: how far the track is from being fixed, mean distance in metres.
    """

    bone: str
    quat: Float[Tensor, " 4"]
    place: Float[Tensor, " 3"]
    spread: float


def rest_transitions(track: ObjectTrack, fps: float) -> list[float]:
    """Times in (0, 1) at which the object starts or stops moving, from its track.

    HOSNeRF has them annotated. Speeds are medians over five frames, so that a jump of the track
    does not count.
    """
    steps = track.translations.diff(dim=0).norm(dim=-1) * fps
    if len(steps) == 0:
        return []
    if track.times is not None:  # gaps in mean ones
        steps = steps / (steps.new_tensor(track.times).diff() * len(steps))
    padded = torch.nn.functional.pad(steps[None], (2, 2), mode="replicate")[0]
    moving = (padded.unfold(0, 5, 1).median(-1).values > STILL).tolist()
    shortest = max(1, round(SHORTEST * fps))
    starts = [0]
    for f in range(1, len(moving)):
        if moving[f] != moving[f - 1]:
            if f - starts[-1] < shortest and len(starts) > 1:
                starts.pop()  # too short to be a state: the state before it goes on
            elif f >= shortest and len(moving) - f >= shortest:
                starts.append(f)
    return [time_of(f, len(track.rotations), track.times) for f in starts[1:]]


def state_of(time: float, transitions: Sequence[float]) -> int:
    """Number of transitions up to and including `time`."""
    return sum(time >= transition for transition in transitions)


def attachment(
    name: str, bone: Frames, track: ObjectTrack, chosen: Bool[Tensor, " F"]
) -> Attachment:
    """Where the object is in a moving frame, on average over the chosen frames."""
    back = bone.rotations[chosen].mT
    apart = track.translations[chosen] - bone.origins[chosen]
    places = (back @ apart[..., None]).squeeze(-1)
    quats = matrices_to_quats(back @ track.rotations[chosen])
    signs = torch.where((quats * quats[:1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    quat, place = normalize_quats((signs * quats).mean(0)), places.median(0).values
    corners = track.points.std(0) if len(track.points) > 1 else track.points.new_zeros(3)
    turned = quats_to_matrices(quats) - quats_to_matrices(quat)
    misses = (places - place).norm(dim=-1) + (turned @ corners).norm(dim=-1)
    return Attachment(name, quat, place, float(misses.mean()))


def attach(
    bones: Mapping[str, Frames], track: ObjectTrack, chosen: Bool[Tensor, " F"], rule: Attach
) -> Attachment:
    """The frame that the object is attached to in the chosen frames of the clip.

    Args:
        bones: to choose from, all of the track's length.
        rule: "nearest" to the object's centre on average, or "steadiest", in which it moves least.
    """
    seen = chosen & track.observed
    seen = seen if seen.any() else chosen
    found = [attachment(name, bone, track, seen) for name, bone in bones.items()]
    if rule == "steadiest":
        return min(found, key=lambda a: a.spread)
    return min(
        found,
        key=lambda a: float((track.translations - bones[a.bone].origins)[seen].norm(dim=-1).mean()),
    )
