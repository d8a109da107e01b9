"""The energy of the body fit: its unknowns, its terms and what they need, precomputed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.skinning import skin
from hoigs.core.values.camera import Camera, pinhole_pixels
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.fit_start import Start, first_guess
from hoigs.preparation.body.ground_scale import ground_scale
from hoigs.preparation.body.joint_limits import limit_penalty
from hoigs.preparation.body.landmarks import (
    BONES,
    FEET,
    LandmarkPoints,
    LandmarkTrack,
    points_of,
)
from hoigs.preparation.body.mask_fit import MaskFit


@dataclass(frozen=True)
class FitOptions:
    """Weights of the fit; the defaults were chosen on a real clip of 247 frames.

    Attributes:
        steps: of Adam, over all frames at once. rate: its rate, radians.
        spread: residual at which a landmark begins to count as an outlier, in image widths.
        bones: of 3D bone directions. limits: of joint limits. rest: of departures from the start,
            which is a straight spine with limbs along the 3D landmarks.
        smooth: of accelerations of the landmarks in the world. turn: of changes of pose.
        shape: of the shape coefficients, in standard deviations.
        offset: of shifts between the landmarks and the body's own points, in `OFFSET`.
        masks: of the distance from masks, in frames without landmarks. mask_spread: residual at
            which a pixel or a point begins to count as an outlier there, in image widths.
        scale: find the cameras' unit in metres too (a moving camera of unknown scale).
    """

    steps: int = 250
    rate: float = 0.03
    spread: float = 0.012
    bones: float = 0.3
    limits: float = 2.0
    rest: float = 0.004
    smooth: float = 30.0
    turn: float = 1.0
    shape: float = 0.01
    offset: float = 0.01
    masks: float = 0.1
    mask_spread: float = 0.03
    scale: bool = False


GAP = 12  # frames between landmarks that smoothness carries a pose across
CARRIED = 0.6  # of the steps, in which frames farther off begin one after another
OFFSET = 0.03  # metres that a landmark's point may well lie off the joint it is named after


@dataclass(frozen=True)
class BodyFit:
    """A fitted body.

    Attributes:
        poses: batched over the frames, in a world of metres.
        residual_px: mean distance of visible landmarks per frame, pixels; NaN where unseen.
        scene_scale: metres a unit of the cameras' own world (1 unless it was requested).
        report: numbers for people.
    """

    poses: BodyPose
    residual_px: Float[Tensor, " F"]
    scene_scale: float
    report: dict[str, Any]


class Unknowns(nn.Module):
    """What is solved for."""

    def __init__(self, start: Start, betas: int, pairs: int, scale: bool) -> None:
        super().__init__()
        self.global_orient = nn.Parameter(start.global_orient.clone())
        self.transl = nn.Parameter(start.transl.clone())
        self.body = nn.Parameter(start.body.clone())
        self.betas = nn.Parameter(torch.zeros(betas))
        self.offsets = nn.Parameter(torch.zeros(pairs, 3))
        self.log_scale = nn.Parameter(torch.tensor(start.scale).log(), requires_grad=scale)

    def pose(self) -> BodyPose:
        hands = self.body.new_zeros(len(self.body), 15, 3)
        return BodyPose(self.global_orient, self.body, hands, hands, self.transl, self.betas)


class FitProblem:
    """The energy and what it needs, precomputed."""

    def __init__(
        self,
        body: BodyModel,
        landmarks: LandmarkTrack,
        cameras: Sequence[Camera],
        options: FitOptions,
    ) -> None:
        self.body, self.options = body, options
        self.points: LandmarkPoints = points_of(body)
        rows = list(self.points.landmarks)
        self.seen: Bool[Tensor, " F"] = landmarks.found
        self.solid = int(landmarks.solid.sum())
        image = landmarks.image[:, rows]
        counted = self.seen[:, None] & landmarks.known[:, rows]
        self.visible = torch.where(counted, image[..., 2], 0.0)
        self.pixels = image[..., :2].nan_to_num()
        self.K = torch.stack([c.K for c in cameras])
        self.viewmats = torch.stack([c.world_to_camera for c in cameras])
        self.width = float(cameras[0].width)
        self.cameras, self.ground = cameras, cameras[0].K.new_zeros(0, 3)
        self.masks: MaskFit | None = None
        self.scale_from = "feet that stand still" if options.scale else "the cameras: given"
        self.bones = torch.tensor([(self.points.index(a), self.points.index(b)) for a, b in BONES])
        world = landmarks.world[:, rows]
        solid = torch.where(torch.isfinite(world).all(-1), self.visible, 0.0)
        self.bone_targets = _directions(world.nan_to_num(), self.bones)
        self.bone_weights = solid[:, self.bones[:, 0]] * solid[:, self.bones[:, 1]]
        above = [body.parents[joint] for joint in self.points.joints.tolist()]
        bones = nn.functional.one_hot(torch.tensor(above), len(body.parents))
        on_skin = body.skinning_weights[self.points.vertices]
        self.carriers = torch.cat((bones.to(on_skin), on_skin))
        self.start = first_guess(body, landmarks, cameras, options.scale)

    def locate(
        self, pose: BodyPose, offsets: Float[Tensor, "P 3"] | None = None
    ) -> Float[Tensor, "F L 3"]:
        """World positions of the points that stand for landmarks, metres.

        A landmark named after a joint moves with the bone above it, a shoulder with the collar
        bone. `offsets` shift the points in the rest pose, left and right as mirror images.
        """
        points = self.points
        vertices, joints = self.body.shaped(pose.betas)
        rest = torch.cat((joints[points.joints], vertices[points.vertices]))
        if offsets is not None:
            rest = rest + offsets[points.pairs] * points.mirror
        return skin(rest, self.body.skinning_transforms(pose), self.carriers)

    def project(
        self, points: Float[Tensor, "F L 3"], scale: Tensor
    ) -> tuple[Float[Tensor, "F L 2"], Float[Tensor, "F L 3"]]:
        """Pixels, and positions along the cameras' axes."""
        turned = points @ self.viewmats[:, :3, :3].mT
        cam = turned + scale * self.viewmats[:, None, :3, 3]
        return pinhole_pixels(self.K[:, None], cam, near=0.1), turned

    @torch.no_grad()
    def carry(self, unknowns: Unknowns, progress: float) -> None:
        """Frames far from landmarks begin one after another, each from its neighbour's current
        pose: masks alone do not separate an arm from what it holds, unless it starts close by. A
        short gap between landmarks is left to smoothness."""
        if self.masks is None or progress > CARRIED:
            return
        frames = torch.arange(len(self.seen))
        found = frames[self.seen]
        after = torch.searchsorted(found, frames)
        last, first = found[(after - 1).clamp_min(0)], found[after.clamp_max(len(found) - 1)]
        ends = (frames < found[0]) | (frames > found[-1])
        distance = torch.minimum((frames - last).abs(), (frames - first).abs())
        nearest = torch.where((frames - last).abs() < (first - frames).abs(), last, first)
        far = ends | ((first - last > GAP) & ~self.seen)
        reach = int(progress / CARRIED * int(distance.max()))
        late = far & (distance > reach)
        toward = nearest + (frames - nearest).sign() * reach
        for values in (unknowns.body, unknowns.global_orient, unknowns.transl):
            values[late] = values[toward[late]]

    @torch.no_grad()
    def rescale(self, unknowns: Unknowns) -> None:
        """Take the scale from the ground at the feet; every camera sees the body where it was."""
        if not len(self.ground):
            return
        old = unknowns.log_scale.exp()
        shift = self.viewmats[:, :3, 3]
        _, turned = self.project(self.locate(unknowns.pose(), unknowns.offsets), old)
        feet = turned[:, [self.points.index(mark) for mark in FEET]] + old * shift[:, None]
        found = ground_scale(feet, self.ground, self.cameras, self.seen)
        if found is None:
            return
        scale, frames = found
        self.scale_from = f"scene points on the ground at the feet, {frames} frames"
        back = self.viewmats[:, :3, :3].mT @ ((old - scale) * shift)[..., None]
        unknowns.transl.add_(back[..., 0])
        unknowns.log_scale.fill_(torch.tensor(scale).log())
        unknowns.log_scale.requires_grad_(False)

    def energy(self, unknowns: Unknowns, widen: float) -> Float[Tensor, ""]:
        options, pose = self.options, unknowns.pose()
        points = self.locate(pose, unknowns.offsets)
        pixels, turned = self.project(points, unknowns.log_scale.exp())
        squared = (pixels - self.pixels).square().sum(-1) / self.width**2
        spread = (options.spread * widen) ** 2
        robust = spread * squared / (squared + spread)  # Geman-McClure
        data = (self.visible * robust).sum() / self.visible.sum() / options.spread**2
        off = (_directions(turned, self.bones) - self.bone_targets).square().sum(-1)
        bones = (self.bone_weights * off).sum() / self.bone_weights.sum().clamp_min(1)
        accelerations = points[2:] - 2 * points[1:-1] + points[:-2]
        turns = unknowns.body[1:] - unknowns.body[:-1]

        def project(where: Tensor) -> Tensor:
            return self.project(where, unknowns.log_scale.exp())[0]

        masks = 0.0 if self.masks is None else self.masks.energy(pose, project, widen)
        terms = (
            data,
            options.masks * masks,
            options.bones * bones,
            options.limits * limit_penalty(unknowns.body),
            options.rest * (unknowns.body - self.start.body).square().sum((-1, -2)).mean(),
            options.shape * unknowns.betas.square().sum(),
            options.offset * (unknowns.offsets / OFFSET).square().sum(),
            options.smooth * accelerations.square().sum(-1).mean() if len(points) > 2 else 0.0,
            options.turn * turns.square().sum(-1).mean() if len(points) > 1 else 0.0,
        )
        return torch.stack([torch.as_tensor(t) for t in terms]).sum()

    def result(self, unknowns: Unknowns) -> BodyFit:
        pose = unknowns.pose().map(lambda x: x.detach().clone())
        scale = unknowns.log_scale.exp()
        pixels, _ = self.project(self.locate(pose, unknowns.offsets.detach()), scale)
        distance = (pixels - self.pixels).norm(dim=-1)
        counted = self.visible > 0.5
        residual = (distance * counted).sum(1) / counted.sum(1)
        mean = float(distance[counted].mean())
        report = {
            "landmark_error_px": round(mean, 2),
            "landmark_error_px_median": round(float(distance[counted].median()), 2),
            "landmark_error_px_at_1280": round(mean * 1280 / self.width, 2),
            "landmark_offset_m_largest": round(float(unknowns.offsets.norm(dim=-1).max()), 3),
            "frames_with_landmarks": int(self.seen.sum()),
            "frames_with_landmarks_in_space": self.solid,
            "frames": len(self.seen),
            "scene_scale": round(float(scale), 5),
            "scene_scale_from": self.scale_from,
        }
        return BodyFit(pose, residual, float(scale), report)


def _directions(points: Float[Tensor, "F L 3"], bones: Tensor) -> Float[Tensor, "F B 3"]:
    """Unit vectors along the bones."""
    ends = points[:, bones]
    return torch.nn.functional.normalize(ends[:, :, 1] - ends[:, :, 0], dim=-1)
