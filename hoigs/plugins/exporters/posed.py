"""People, objects and the world over the exported moments, in the axes of other programs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    axis_angle_to_quats,
    kabsch,
    matrices_to_quats,
    multiply_quats,
    quats_to_axis_angle,
    quats_to_matrices,
    slerp,
)
from hoigs.core.maths.spherical_harmonics import rotate_sh
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.values.between import frame_of
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment

# The world of a clip turned to the axes of other programs.

Up = Literal["clip", "y", "z"]
AXES: dict[Up, str] = {
    "clip": "the world of the clip; cameras are OpenCV's (x right, y down, z forward)",
    "y": "right-handed, y up: the world of the clip, turned so that its up is +y and moved along "
    "it so that its floor is y = 0",
    "z": "right-handed, z up: the world of the clip, turned so that its up is +z and moved along "
    "it so that its floor is z = 0",
}


class TurnedExporter(Exporter):
    """An exporter with a setting `up`: how the world of the clip is turned."""

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        up: Up = self.config.up
        self.up, self.axes = up, AXES[up]


@dataclass(frozen=True)
class Move:
    """A rigid motion of the world: x becomes turn x + shift, metres."""

    turn: Float[Tensor, "3 3"]
    shift: Float[Tensor, " 3"]

    def points(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points of the clip's world in the new one."""
        return points @ self.turn.to(points).mT + self.shift.to(points)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in the new world: means, orientations and SH colours."""
        means, quats, sh = gaussians.means, gaussians.quats, gaussians.sh
        if not torch.equal(self.turn, torch.eye(3)):
            turn = self.turn.to(means)
            quats = multiply_quats(matrices_to_quats(turn).expand_as(quats), quats)
            sh = rotate_sh(sh, turn)
        return gaussians.replace(means=self.points(means), quats=quats, sh=sh)


def world_move(clip: Clip, up: Up) -> Move:
    """From the world of the clip to one in which `up` is upward and the floor is at 0, float32.

    Where the clip knows no floor, its origin stays.
    """
    if up == "clip":
        return Move(torch.eye(3), torch.zeros(3))
    target = torch.tensor((0.0, 1.0, 0.0) if up == "y" else (0.0, 0.0, 1.0))
    turn = rotation_between(clip.world.up_vector(), target)
    return Move(turn, -(clip.world.floor or 0.0) * target)


def rotation_between(a: Float[Tensor, " 3"], b: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes the unit vector `a` to `b`."""
    axis = torch.linalg.cross(a, b)
    sine, cosine = axis.norm(), torch.dot(a, b)
    if sine < 1e-6:
        if cosine > 0:
            return torch.eye(3)
        axis, sine = torch.linalg.cross(a, a.roll(1) + torch.tensor((0.3, 0.0, 0.0))), sine * 0
        axis = axis / axis.norm()
        return axis_angle_to_matrices(axis * torch.pi)
    return axis_angle_to_matrices(axis / sine * torch.atan2(sine, cosine))


@dataclass(frozen=True)
class BodyMotion:
    """One person over F moments, on the CPU.

    Attributes:
        name: the entity's name. model: registry key of the body, as the clip has it.
        body: its model. betas: shape, one for all moments.
        rotations: axis-angle of each joint in its parent's frame; zero is the T-pose.
        transl: the pelvis is at rest_joints[0] + transl, metres.
        scale: scale of the whole body about its pelvis.
        rest_joints: in the T-pose, metres, unscaled.
    """

    name: str
    model: str
    gender: str | None
    body: BodyModel
    betas: Float[Tensor, " B"]
    rotations: Float[Tensor, "F J 3"]
    transl: Float[Tensor, "F 3"]
    scale: float
    rest_joints: Float[Tensor, "J 3"]

    def __len__(self) -> int:
        return len(self.transl)

    @property
    def pelvis(self) -> Float[Tensor, "F 3"]:
        """Metres, world."""
        return self.rest_joints[0] + self.transl

    def pose(self, index: int) -> BodyPose:
        """The pose at one moment, with flat hands."""
        turns = self.rotations[index]
        hands = turns[-30:]
        return BodyPose(
            turns[0], turns[1:22], hands[:15], hands[15:], self.transl[index], self.betas
        )

    def joints(self, index: int) -> Float[Tensor, "J 3"]:
        """World, metres, at one moment."""
        return self._scaled(self.body(self.pose(index)).joints, index)

    def vertices(self, index: int) -> Float[Tensor, "V 3"]:
        """World, metres, at one moment."""
        return self._scaled(self.body(self.pose(index)).vertices, index)

    def _scaled(self, points: Float[Tensor, "P 3"], index: int) -> Float[Tensor, "P 3"]:
        return self.pelvis[index] + self.scale * (points - self.pelvis[index])

    def moved(self, move: Move) -> BodyMotion:
        """The same in a world that is moved."""
        # in float64, as turns near 180 degrees lose digits in float32
        roots = axis_angle_to_quats(self.rotations[:, 0].double())
        first = matrices_to_quats(move.turn.double()).expand_as(roots)
        rotations = self.rotations.clone()
        rotations[:, 0] = quats_to_axis_angle(multiply_quats(first, roots)).to(rotations)
        transl = move.points(self.pelvis) - self.rest_joints[0]
        return replace(self, rotations=rotations, transl=transl)


def body_motions(request: ExportRequest) -> list[BodyMotion]:
    """The people among the entities to export.

    Raises:
        HoigsError: one has no body model.
    """
    return [body_motion(request, name) for name in request.of_kind("human")]


@torch.no_grad()
def body_motion(request: ExportRequest, name: str) -> BodyMotion:
    """One person; poses are those that are drawn: refined, and corrected by the interaction.

    Raises:
        HoigsError: there is no body model for this person, or no pose at a moment.
    """
    if name not in request.bodies:
        raise HoigsError(f'"{name}" has no body model, so there is no skeleton to export')
    body = request.bodies[name].cpu()
    poses = [_pose(request, name, moment).to("cpu") for moment in request.moments]
    betas = torch.stack([pose.betas for pose in poses]).mean(0)
    rotations = torch.stack([body.joint_rotations(pose) for pose in poses])
    rest = body.shaped(betas)[1]
    track = request.clip.bodies.get(name)
    model, gender = (track.model, track.gender) if track else (type(body).__name__, None)
    deformation = request.scene.entity(name).deformation
    scale = 1.0
    if isinstance(deformation, ProvidesSkeleton):
        scale = float(deformation.arm_length().cpu() / body.arm_length(betas))
        scale = 1.0 if abs(scale - 1) < 1e-4 else scale
        pelvis = torch.stack([deformation.anchors(m)[0].cpu() for m in request.moments])
    else:
        pelvis = torch.stack([body.shaped(p.betas)[1][0] + p.transl for p in poses])
    return BodyMotion(
        name, model, gender, body, betas, rotations, pelvis - rest[0], scale, rest
    )  # fmt: skip


def _pose(request: ExportRequest, name: str, moment: Moment) -> BodyPose:
    deformation = request.scene.entity(name).deformation
    if not isinstance(deformation, ProvidesSkeleton):
        if name not in moment.poses:
            raise HoigsError(f'the moment at {float(moment.time):.3f} has no pose of "{name}"')
        return moment.poses[name]
    pose = deformation.pose(moment)
    residual = request.scene(moment, [name]).residuals.get(name)
    if residual is None or residual.pose is None or "pose" not in deformation.residuals:
        return pose
    rule: Any = getattr(getattr(deformation, "config", None), "residual_rule", "add")
    return pose.with_residual(residual.pose, rule)


# The rigid motion of an object over the exported moments.

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


EYES = 8  # cameras of the video, of whose views of a colour the mean is taken


def eyes_of(clip: Clip) -> list[Float[Tensor, " 3"]]:
    """Centres of some cameras of the video, spread over it: world of the clip, metres."""
    return [camera.to("cpu").center for camera in clip.cameras[:: max(1, len(clip) // EYES)]]
