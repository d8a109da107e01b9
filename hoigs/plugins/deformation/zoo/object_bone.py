"""deformation:object-bone: an object attached to a wrist, as one more bone of the skeleton
(HOSNeRF, Liu et al. 2023).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST, BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.frame_times import FrameTimes, time_of
from hoigs.core.maths.rotations import (
    matrices_to_quats,
    move_rigidly,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Residual, displaced
from hoigs.plugins.deformation.skinned_body import FrameCorrections, clip_settings
from hoigs.plugins.deformation.zoo.rigid_frames import mean_square

# When an object's state changes (HOSNeRF, Liu et al. 2023), and the frame that each state is
# attached to.

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


WORLD = "world"
WRISTS = {"left": LEFT_WRIST, "right": RIGHT_WRIST}


class ObjectBoneConfig(ComponentConfig):
    """HOSNeRF's object bones and states."""

    transitions: list[float] | Literal["track"] = "track"
    """Times in (0, 1) between states; "track" takes those at which the object's track starts or
    stops moving, [] has one state."""
    attach: Attach = "steadiest"
    """The frame that the object is fixed in during a state. "nearest" wrist; or "steadiest", the
    wrist in whose frame the object moves least, or the world itself, where HOSNeRF's object becomes
    part of the scene."""
    refine: bool = True
    """Learn a small rigid correction for each frame too."""


class ObjectBone(DeformationModel):
    """x(t) = B(t) O_s p: B is a wrist's frame in the world, O_s a learned SE(3) of each state s.

    B(t) turns with the wrist and has its origin there; it follows the poses of the moment as the
    clip has them, not as a human's deformation refines them. With O_s the identity the object's
    centre is the wrist joint. At the start O_s is where the track has the object in that frame, on
    average over the state.

    Parameters: `offset_quats` [S, 4], `offset_translations` [S, 3], metres, in the bone's frame.

    Args:
        config: `transitions` and `attach` are used by `from_config` alone.
        bodies: body of each human, by entity.
        attachments: bone and first offset of each state; a bone is "HUMAN/left", "HUMAN/right" or
            "world".
        transitions: times between states, ascending, one fewer than attachments.
        num_frames: frames in the clip; needed for corrections (`refine`).
        trained_frames: frames that are trained on; all when absent.
    """

    Config: ClassVar = ObjectBoneConfig
    kinds = frozenset({"object"})
    rates: ClassVar[Mapping[str, str]] = {
        "offset_quats": "keyframe_rotation",
        "offset_translations": "keyframes",
        "corrections.turns": "keyframe_rotation",
        "corrections.shifts": "keyframes",
    }

    def __init__(
        self,
        config: ObjectBoneConfig | None = None,
        *,
        bodies: Mapping[str, BodyModel],
        attachments: Sequence[Attachment],
        transitions: Sequence[float] = (),
        num_frames: int,
        trained_frames: Sequence[int] | None = None,
        frame_times: FrameTimes = None,
    ) -> None:
        super().__init__()
        self.config = config or ObjectBoneConfig()
        if len(attachments) != len(transitions) + 1:
            raise ValueError(
                f"{len(transitions)} transitions make {len(transitions) + 1} states, got "
                f"{len(attachments)} attachments"
            )
        # in a mapping, so that bodies are no submodules: their data belongs to no checkpoint
        self._bodies = dict(bodies)
        self.bones = [a.bone for a in attachments]
        for bone in self.bones:
            human, _, side = bone.rpartition("/")
            if bone != WORLD and (human not in bodies or side not in WRISTS):
                raise ValueError(
                    f'"{bone}" is no bone; known: {WORLD}, '
                    + ", ".join(f"{h}/{s}" for h in bodies for s in WRISTS)
                )
        self.transitions = list(transitions)
        self.continuous = not self.transitions
        self.offset_quats = nn.Parameter(torch.stack([a.quat for a in attachments]))
        self.offset_translations = nn.Parameter(torch.stack([a.place for a in attachments]))
        refine = self.config.refine
        self.corrections = (
            FrameCorrections(num_frames, trained_frames, frame_times) if refine else None
        )

    @classmethod
    def from_config(cls, config: ObjectBoneConfig, context: BuildContext) -> Self:
        track, clip = context.object_track, context.clip
        if track is None or clip is None:
            raise ValueError(
                "deformation:object-bone needs a clip and a track; it suits entities of kind object"
            )
        if not context.bodies:
            raise ValueError(
                "deformation:object-bone needs a human in the model, to whose wrist it is attached"
            )
        times = config.transitions
        if times == "track":
            times = rest_transitions(track, clip.fps)
        elif sorted(set(times)) != times or any(not 0 < t < 1 for t in times):
            raise ValueError(f"transitions must ascend within (0, 1), got {times}")
        poses = {name: clip.bodies[name].poses for name in context.bodies}
        found = attachments_of(context.bodies, poses, track, times, config.attach)
        return cls(
            config,
            bodies=context.bodies,
            attachments=found,
            transitions=times,
            num_frames=len(track.rotations),
            trained_frames=clip_settings(clip)["trained_frames"],
            frame_times=track.times,
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        for body in self._bodies.values():
            body._apply(fn, recurse)
        return super()._apply(fn, recurse)

    def bone(self, name: str, moment: Moment) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"]]:
        """Rotation (wxyz) and origin of a bone in the world, metres."""
        if name == WORLD:
            like = self.offset_quats
            return like.new_tensor((1.0, 0, 0, 0)), like.new_zeros(3)
        human, _, side = name.rpartition("/")
        if human not in moment.poses:
            raise ValueError(
                f'the moment has no body pose for "{human}"; it has '
                f"{sorted(moment.poses) or 'none'}"
            )
        turn, origin = joint_frame(self._bodies[human], moment.poses[human], WRISTS[side])
        return matrices_to_quats(turn), origin

    def pose(self, moment: Moment) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"]]:
        """Rotation (wxyz) and place of the object in the world, metres."""
        state = state_of(moment.time, self.transitions)
        quat = normalize_quats(self.offset_quats[state])
        place = self.offset_translations[state]
        if self.corrections is not None:
            turn, shift = self.corrections(moment.time)
            quat, place = multiply_quats(turn, quat), place + shift
        turn, origin = self.bone(self.bones[state], moment)
        return multiply_quats(turn, quat), quats_to_matrices(turn) @ place + origin

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        quat, place = self.pose(moment)
        means, quats = move_rigidly(canonical.means, normalize_quats(canonical.quats), quat, place)
        return canonical.replace(means=displaced(means, residual), quats=quats)

    def regularizers(self) -> dict[str, Tensor]:
        """ "correction": mean squared turns, radians, and shifts, metres, of the frames."""
        if self.corrections is None:
            return {}
        return {"correction": mean_square(self.corrections)}


def joint_frame(
    body: BodyModel, pose: BodyPose, joint: int
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """The frame of a joint in the world: it turns with the joint, whose place is its origin.

    Gradients stop here: a body's poses are learned from the body, not from the objects it holds.
    """
    with torch.no_grad():
        transform = body.skinning_transforms(pose)[joint]
        place = body.shaped(pose.betas)[1][joint]
        return transform[:3, :3], transform[:3, :3] @ place + transform[:3, 3]


def attachments_of(
    bodies: Mapping[str, BodyModel],
    poses: Mapping[str, BodyPose],
    track: ObjectTrack,
    transitions: Sequence[float],
    rule: Attach,
) -> list[Attachment]:
    """The frame that the object is attached to in each state, and where it is in that frame.

    Args:
        poses: by human, batched over the track's frames.
    """
    frames = len(track.rotations)
    bones: dict[str, Frames] = {}
    for human, body in bodies.items():
        for side, joint in WRISTS.items():
            each = [joint_frame(body, poses[human].frame(f), joint) for f in range(frames)]
            turns, origins = (torch.stack(column) for column in zip(*each, strict=True))
            bones[f"{human}/{side}"] = Frames(turns, origins)
    if rule == "steadiest":
        still = torch.eye(3).expand(frames, 3, 3)
        bones[WORLD] = Frames(still, torch.zeros(frames, 3))
    states = [state_of(time_of(f, frames, track.times), transitions) for f in range(frames)]
    found = []
    for state in range(len(transitions) + 1):
        chosen = torch.tensor([s == state for s in states])
        if not chosen.any():
            raise ValueError(f"no frame lies between the transitions {list(transitions)}")
        found.append(attach(bones, track, chosen, rule))
    return found
