"""What goes into the body fit and what comes out: settings, unknowns, result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_quats, multiply_quats, quats_to_axis_angle
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.kinematics import nearest_turn
from hoigs.preparation.body.priors import Noise
from hoigs.preparation.body.start import Start


@dataclass(frozen=True)
class FitOptions:
    """Settings of the fit. Noise is estimated, so that few weights are left to choose.

    Attributes:
        steps: of Gauss and Newton, at most.
        spread: how far a landmark may be off at first, in image widths; `Noise` replaces it.
        space: the same of a 3D landmark, metres.
        unit: standard deviation of the 3D landmarks' unit of length, in parts of a metre.
        smooth: acceleration of points of the body in the world, m/s^2, that is ordinary; larger
            ones cost less than their square (a throw is no error).
        shape: standard deviation of the shape coefficients, in those of the body model.
        size: standard deviation of the body's size about `mean_size`, in parts of the model's mean.
            Adults differ by 4 %, but 3D landmarks by a network do not measure size, and one still
            camera shows none: the mean is the best guess, which only plain evidence may move
            (cameras in metres that move, see the body from several sides).
        mean_size: of the body, in parts of the model's mean; other than 1 where the person's height
            is known. 3D landmarks, of a person of average height, are taken in that unit.
        offset: standard deviation of the distance from a landmark to the body's own point that
            stands for it, metres on a body of the mean size.
        masks: number of landmarks that a mask weighs as much as. mask_spread: residual at which a
            pixel or a point begins to count as an outlier there, in image widths.
        scale: find the cameras' unit in metres too (a moving camera of unknown scale).
    """

    steps: int = 40
    spread: float = 0.006
    space: float = 0.05
    unit: float = 0.015
    smooth: float = 6.0
    shape: float = 0.3
    size: float = 0.005
    mean_size: float = 1.0
    offset: float = 0.003
    masks: float = 10.0
    mask_spread: float = 0.03
    scale: bool = False


@dataclass(frozen=True)
class BodyFit:
    """A fitted body.

    Attributes:
        poses: batched over the frames, in a world of metres.
        residual_px: mean distance of visible landmarks per frame, pixels; NaN where unseen.
        scene_scale: metres a unit of the cameras' own world (1 unless it was requested).
        report: numbers for people.
        joints: of a fit in windows, where one follows another.
    """

    poses: BodyPose
    residual_px: Float[Tensor, " F"]
    scene_scale: float
    report: dict[str, Any]
    joints: tuple[Joint, ...] = ()


@dataclass(frozen=True)
class Joint:
    """Where a window takes over from the one before it, and how far both are apart there.

    Attributes:
        frame: the first that is the later window's own.
        metres, degrees: largest distance of a joint's places, and angle between its orientations in
            the world, by the two windows.
    """

    frame: int
    metres: float
    degrees: float


@dataclass(frozen=True)
class Unknowns:
    """What is solved for.

    Attributes:
        pose: batched, one shape, no hands; float64.
        offsets: of each left-right pair of landmarks in the rest pose, metres.
        unit: by how much the 3D landmarks are too large, in parts of 1.
        scale: metres a unit of the cameras' world.
    """

    pose: BodyPose
    offsets: Float[Tensor, "P 3"]
    unit: float
    scale: float

    @staticmethod
    def start(start: Start, betas: int, pairs: int) -> Unknowns:
        hands = start.body.new_zeros(len(start.body), 15, 3)
        pose = BodyPose(
            start.global_orient, start.body, hands, hands, start.transl, torch.zeros(betas)
        )
        offsets = torch.zeros(pairs, 3, dtype=torch.float64)
        return Unknowns(pose.to(torch.float64), offsets, 0.0, start.scale)

    def moved(self, frames: Float[Tensor, "F N"], shared: Float[Tensor, " S"]) -> Unknowns:
        """After a step; `shared` is empty where that of shape, offsets, unit and scale is none."""
        pose, betas = self.pose, len(self.pose.betas)
        if not len(shared):
            shared = shared.new_zeros(betas + self.offsets.numel() + 2)
        turned = multiply_quats(
            axis_angle_to_quats(pose.global_orient), axis_angle_to_quats(frames[:, 3:6])
        )
        pose = pose.replace(
            transl=pose.transl + frames[:, :3],
            global_orient=nearest_turn(quats_to_axis_angle(turned)),
            body=pose.body + frames[:, 6:].unflatten(-1, (21, 3)),
            betas=pose.betas + shared[:betas],
        )
        offsets = self.offsets + shared[betas:-2].unflatten(0, (-1, 3))
        unit = self.unit + float(shared[-2])
        return Unknowns(pose, offsets, unit, max(self.scale + float(shared[-1]), 1e-4))


@dataclass(frozen=True)
class Found:
    """What one fit has found and another keeps: all that frames share, and the first frames.

    Attributes:
        ordinary: accelerations of `MotionPrior`. pose: of the first frames; None: of none.
    """

    noise: Noise
    ordinary: Float[Tensor, " K"]
    betas: Float[Tensor, " B"]
    offsets: Float[Tensor, "P 3"]
    unit: float
    pose: BodyPose | None = None

    @property
    def frames(self) -> int:
        return 0 if self.pose is None else len(self.pose.transl)

    def begin(self, unknowns: Unknowns) -> Unknowns:
        """The start of a fit that keeps this."""
        pose = unknowns.pose.replace(betas=self.betas)
        if self.pose is not None:
            first, rest = self.pose, pose.frame(slice(self.frames, None))
            orient = torch.cat((first.global_orient, rest.global_orient))
            pose = pose.replace(
                global_orient=nearest_turn(orient),
                body=torch.cat((first.body, rest.body)),
                transl=torch.cat((first.transl, rest.transl)),
            )
        return Unknowns(pose, self.offsets, self.unit, unknowns.scale)
