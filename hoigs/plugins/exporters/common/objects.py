"""The rigid motion of an object over the exported moments."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import kabsch, matrices_to_quats, quats_to_matrices, slerp
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.values.between import frame_of
from hoigs.core.values.clip import ObjectTrack

SEEN = 0.1  # opacity of Gaussians that count as part of the surface


@dataclass(frozen=True)
class ObjectMotion:
    """An object over F moments, on the CPU.

    Attributes:
        rotations, translations: object to world, metres. The object's frame is that of the clip's
            track; without one, the world's axes about the mean of its first Gaussians.
        residual: RMS distance of the Gaussians from this rigid motion, metres.
        points, colors: Gaussians of the first moment in the object's frame, RGB in [0, 1].
    """

    name: str
    rotations: Float[Tensor, "F 3 3"]
    translations: Float[Tensor, "F 3"]
    residual: float
    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]


def object_motions(request: ExportRequest) -> list[ObjectMotion]:
    """The objects among the entities to export."""
    return [object_motion(request, name) for name in request.of_kind("object")]


@torch.no_grad()
def object_motion(request: ExportRequest, name: str) -> ObjectMotion:
    """The motion that best fits the Gaussians of an object (Kabsch), from the first moment on."""
    states = [request.scene(m, [name]).gaussians[name] for m in request.moments]
    first = states[0].means.detach().double().cpu()
    start, middle = _start(request, name, first)
    rotations, translations, errors = [], [], []
    for state in states:
        means = state.means.detach().double().cpu()
        turn = kabsch(first, means) if len(first) >= 3 else torch.eye(3, dtype=torch.float64)
        shift = means.mean(0) - turn @ first.mean(0)
        errors.append((first @ turn.mT + shift - means).square().sum(-1).mean())
        rotations.append(turn @ start)
        translations.append(turn @ middle + shift)
    seen = (states[0].opacities > SEEN).cpu()
    seen = seen if bool(seen.any()) else torch.ones_like(seen)
    return ObjectMotion(
        name,
        torch.stack(rotations).float(),
        torch.stack(translations).float(),
        float(torch.stack(errors).mean().sqrt()),
        ((first - middle) @ start)[seen].float(),
        states[0].colors.detach().cpu().clamp(0, 1)[seen],
    )


def _start(
    request: ExportRequest, name: str, means: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """Pose of the object at the first moment, float64."""
    track = request.clip.objects.get(name)
    if track is None:
        return torch.eye(3, dtype=torch.float64), means.mean(0)
    return track_pose(track, frame_of(request.clip, request.moments[0]))


def track_pose(
    track: ObjectTrack, frame: float
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """A track at a frame number that need not be whole, float64."""
    last = len(track.translations) - 1
    low = min(max(int(frame), 0), last)
    high, r = min(low + 1, last), min(max(frame - low, 0.0), 1.0)
    pair = track.rotations[[low, high]].double().cpu()
    quats = matrices_to_quats(pair)
    places = track.translations[[low, high]].double().cpu()
    return quats_to_matrices(slerp(quats[0], quats[1], r)), torch.lerp(places[0], places[1], r)
