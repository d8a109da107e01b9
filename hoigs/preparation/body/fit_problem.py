"""The energy of the body fit: its unknowns, its terms and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import axis_angle_to_quats, multiply_quats, quats_to_axis_angle
from hoigs.core.values.camera import Camera, pinhole_pixels
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.face import Size, faces_of
from hoigs.preparation.body.fitted import BodyErrors, BodyFit
from hoigs.preparation.body.kinematics import (
    REACH,
    Kinematics,
    NormalEquations,
    Posed,
    nearest_turn,
)
from hoigs.preparation.body.landmarks import FEET, TORSO, LandmarkPoints, Landmarks, points_of
from hoigs.preparation.body.mask_fit import MaskFit, Masks, Project
from hoigs.preparation.body.priors import REST_LASTS as LASTS
from hoigs.preparation.body.priors import MotionPrior, PosePrior, robust_weights
from hoigs.preparation.body.start import Start, first_guess
from hoigs.preparation.options import FIT_STEPS


@dataclass(frozen=True)
class FitOptions:
    """Settings of the fit.

    Attributes:
        steps: of Gauss and Newton, at most.
        unit: standard deviation of the 3D landmarks' unit of length, in parts of a metre.
        smooth: acceleration of points of the body in the world, m/s^2, that is ordinary; larger
            ones cost less than their square (a throw is no error).
        shape: standard deviation of the shape coefficients, in those of the body model.
        size: standard deviation of the body's size about `mean_size`, in parts of the model's mean.
            3D landmarks by a network do not measure size, and one still camera shows none but the
            face's: what that makes of it is the best guess, which only plain evidence may move
            (cameras in metres that move, see the body from several sides).
        mean_size: of the body, in parts of the model's mean, where the person's height is known;
            None: as the face shows, and adults are (`Size`). 3D landmarks, of a person of average
            height, are taken in that unit.
        offset: standard deviation of the distance from a landmark to the body's own point that
            stands for it, metres on a body of the mean size.
        masks: number of landmarks that a mask weighs as much as. mask_spread: residual at which a
            pixel or a point begins to count as an outlier there, in image widths.
        scale: find the cameras' unit in metres too (a moving camera of unknown scale).
    """

    steps: int = FIT_STEPS
    unit: float = 0.1
    smooth: float = 6.0
    shape: float = 0.3
    size: float = 0.005
    mean_size: float | None = None
    offset: float = 0.003
    masks: float = 10.0
    mask_spread: float = 0.03
    scale: bool = False


@dataclass(frozen=True)
class Observations:
    """What a body is fitted to.

    Attributes:
        cameras: one a frame, as `landmarks` has them.
        times: of the frames, seconds; by default 30 frames a second.
        turns: axis-angle of joints 1..21 as another program has found them: the fit starts there,
            and `PosePrior` holds it near.
        points: of the scene, in the cameras' own unit; only used to find the scale.
        masks: one a frame, of the person or of all that moves.
    """

    landmarks: Landmarks
    cameras: Sequence[Camera]
    times: Float[Tensor, " F"] | None = None
    turns: Float[Tensor, "F 21 3"] | None = None
    points: Float[Tensor, "S 3"] | None = None
    masks: Masks | None = None

    @property
    def seconds(self) -> Float[Tensor, " F"]:
        return torch.arange(len(self.cameras)) / 30.0 if self.times is None else self.times

    def rows(self, frames: slice | Int[Tensor, " T"]) -> Observations:
        """Of some frames alone, without their masks."""
        numbers = torch.arange(len(self.cameras))[frames].tolist()
        return replace(
            self,
            landmarks=self.landmarks.rows(frames),
            cameras=[self.cameras[i] for i in numbers],
            times=self.seconds[frames],
            turns=None if self.turns is None else self.turns[frames],
            masks=None,
        )


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
        noise: of landmarks, pixels. ordinary: accelerations of `MotionPrior`. pose: of the first
            frames; None: of none.
    """

    noise: float
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


SIDE, ABOVE = 0.15, 0.04  # half size of the window about a foot's point, in image widths
ENOUGH_POINTS, ENOUGH_FRAMES = 4, 3


def ground_scale(
    feet: Float[Tensor, "F P 3"],
    points: Float[Tensor, "S 3"],
    cameras: Sequence[Camera],
    seen: Bool[Tensor, " F"],
) -> tuple[float, int] | None:
    """Ratio of the feet's depth to that of the scene points seen beside them.

    A foot stands on what the picture shows beside it. A foot in the air has farther ground behind
    it, which gives too small a scale, so of each frame's points only the half with the largest
    scale count; the median over frames removes the effect of jumps and of points elsewhere.

    Args:
        feet: heels and toes along each camera's axes, metres.
        points: of the scene, in the cameras' own unit.
        seen: frames to look at.

    Returns:
        The scale and the number of frames that gave it; None with fewer than three such frames.
    """
    ratios = []
    for i in seen.nonzero().squeeze(1).tolist():
        camera = cameras[i]
        pixels, depth = camera.project(points)
        inside = (depth > 0) & (pixels[:, 1] < camera.height) & (pixels[:, 1] > 0)
        at = pinhole_pixels(camera.K, feet[i])
        off = (pixels[:, None] - at).abs() / camera.width
        near = (off[..., 0] < SIDE) & (off[..., 1] < ABOVE) & inside[:, None]
        enough = near.sum(0) >= ENOUGH_POINTS
        of_feet = [
            feet[i, foot, 2] / depth[near[:, foot]].median()
            for foot in enough.nonzero().squeeze(1).tolist()
        ]
        if of_feet:
            ratios.append(_mean_of_upper_half(torch.stack(of_feet)))
    if len(ratios) < ENOUGH_FRAMES:
        return None
    return float(torch.stack(ratios).median()), len(ratios)


def _mean_of_upper_half(values: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    return values.sort(descending=True).values[: (len(values) + 1) // 2].mean()


NOSE = 0  # landmark
GAP = 12  # frames between landmarks that smoothness carries a pose across
CARRIED = 0.6  # of the steps, in which frames farther off begin one after another
SURFACE = 1.7  # of a landmark on the skin against one at a joint: how uncertain its place is
REWEIGHTINGS = 3  # for the 3D landmarks' origin
AT_ONCE = 256  # frames whose derivatives are in memory
ALL = slice(None)
OF_FRAMES = ("visible", "pixels", "K", "viewmats", "in_space", "space")
# standard deviations of landmarks in the image, a component: metres on the person, and pixels at
# least (benchmarks/landmark_errors.py). Estimates from the fit's own residuals came out smaller on
# every recording: what is off alike in all frames does not show there.
IN_IMAGE, LEAST_PIXELS = 0.015, 1.0
SPACE_LASTS = 0.5  # seconds in which the error of a 3D landmark stays what it is


class FitProblem:
    """The energy and what it needs, precomputed.

    Args:
        seen: its masks are looked at after `show`, its points as `ground`.
        start: where the fit begins, in place of `first_guess`.
        found: what another fit has found, and this one keeps.
    """

    def __init__(
        self,
        body: BodyModel,
        seen: Observations,
        options: FitOptions,
        start: Start | None = None,
        found: Found | None = None,
    ) -> None:
        self.body, self.options, self.found = body, options, found
        landmarks, cameras, times, turns = seen.landmarks, seen.cameras, seen.seconds, seen.turns
        self.points: LandmarkPoints = points_of(body)
        self.kinematics = Kinematics(body, self.points.joints, self.points.vertices)
        rows = list(self.points.landmarks)
        self.seen: Bool[Tensor, " F"] = landmarks.found
        given = options.mean_size
        self.size = Size() if given is None else Size(given, options.size, "as given")
        self.faces = faces_of(landmarks.image, torch.stack([c.K for c in cameras]))
        self.solid = int(landmarks.solid.sum())
        image = landmarks.image[:, rows].double()
        counted = self.seen[:, None] & landmarks.known[:, rows]
        self.visible = torch.where(counted, image[..., 2], 0.0)
        self.pixels = image[..., :2].nan_to_num()
        self.K = torch.stack([c.K for c in cameras]).double()
        self.viewmats = torch.stack([c.world_to_camera for c in cameras]).double()
        self.width = float(cameras[0].width)
        self.cameras, self.ground = cameras, cameras[0].K.new_zeros(0, 3)
        self.masks: MaskFit | None = None
        self.scale_from = "feet that stand still" if options.scale else "the cameras: given"
        self.find_scale = options.scale
        world = landmarks.world[:, rows].double()
        self.in_space = torch.where(torch.isfinite(world).all(-1), self.visible, 0.0)
        self.space = world.nan_to_num()  # metres, along the cameras' axes
        self.spread = landmarks.spread
        steps = (times[1:] - times[:-1]).double().clamp_min(1e-4)
        apart = torch.nn.functional.pad(steps, (1, 1), value=float(steps.median()))
        self.spacing = 0.5 * (apart[1:] + apart[:-1])  # seconds that each frame stands for
        self.in_space *= (self.spacing / SPACE_LASTS).clamp_max(1.0)[:, None]
        self.shape = torch.zeros(
            body.num_betas, dtype=torch.float64
        )  # by which masks move the most probable
        self.prior = PosePrior(turns)
        torso = [self.points.index(mark) for mark in TORSO]
        self.motion = MotionPrior(self.kinematics, torso, len(rows), times, options.smooth)
        pairs = int(self.points.pairs.max()) + 1
        onto = torch.nn.functional.one_hot(self.points.pairs, pairs).double()
        self.onto_offsets = (onto[:, :, None] * self.points.mirror[:, None]).double()  # [L, P, 3]
        surface = (onto[len(self.points.joints) :].sum(0) > 0).double()
        self.offset_spread = options.offset * (1 + (SURFACE - 1) * surface)
        start = start or first_guess(body, landmarks, cameras, options.scale)
        self.noise = max(IN_IMAGE * self._pixels_a_metre(start), LEAST_PIXELS)
        if turns is not None:
            start = replace(start, body=turns)
        self.begin = Unknowns.start(start, body.num_betas, pairs)
        self.placed = self.seen.clone()  # frames that the others follow
        if found is not None:
            self.noise, self.begin = found.noise, found.begin(self.begin)
            self.placed[: found.frames] = True
            self.motion.suppose(found.ordinary)

    def _pixels_a_metre(self, start: Start) -> float:
        """Of the person in the image where the fit begins, median over frames with landmarks."""
        root = self.kinematics.joints[0] + start.transl.double()
        cam = self.viewmats[:, :3, :3] @ root[..., None] + start.scale * self.viewmats[:, :3, 3:]
        return float((self.K[:, 0, 0] / cam[:, 2, 0].clamp_min(0.1))[self.seen].median())

    def show(self, masks: Masks, first: int = 0) -> None:
        """Look at masks in the frames without landmarks; `first` is the number of frame 0."""
        unseen = {i: masks[first + i] for i in (~self.seen).nonzero()[:, 0].tolist()}
        if unseen and self.options.masks:
            self.masks = MaskFit(self.body, unseen, self.options.mask_spread, self.options.masks)

    def posed(self, unknowns: Unknowns, derivatives: bool = True, frames: slice = ALL) -> Posed:
        """The points that stand for landmarks.

        A landmark named after a joint moves with the bone above it, a shoulder with the collar
        bone. Offsets shift the points in the rest pose, left and right as mirror images.
        """
        shift = unknowns.offsets[self.points.pairs] * self.points.mirror
        return self.kinematics.posed(unknowns.pose.frame(frames), shift, derivatives)

    def of(self, frames: slice) -> FitProblem:
        """The part of the problem that some frames are, for the terms of single frames."""
        part = copy(self)
        for name in OF_FRAMES:
            setattr(part, name, getattr(self, name)[frames])
        return part

    def in_cameras(
        self, points: Float[Tensor, "F L 3"], scale: float
    ) -> tuple[Float[Tensor, "F L 2"], Float[Tensor, "F L 3"]]:
        """Pixels, and places in the cameras' axes."""
        cam = points @ self.viewmats[:, :3, :3].mT + scale * self.viewmats[:, None, :3, 3]
        return pinhole_pixels(self.K[:, None], cam, near=0.1), cam

    @torch.no_grad()
    def carry(self, unknowns: Unknowns, progress: float) -> Unknowns:
        """Frames far from landmarks begin one after another, each from its neighbour's current
        pose: masks alone do not separate an arm from what it holds, unless it starts close by. A
        short gap between landmarks is left to smoothness."""
        if self.masks is None or progress > CARRIED or bool(self.placed.all()):
            return unknowns
        frames = torch.arange(len(self.placed))
        found = frames[self.placed]
        if not len(found):
            return unknowns
        after = torch.searchsorted(found, frames)
        last, first = found[(after - 1).clamp_min(0)], found[after.clamp_max(len(found) - 1)]
        ends = (frames < found[0]) | (frames > found[-1])
        distance = torch.minimum((frames - last).abs(), (frames - first).abs())
        nearest = torch.where((frames - last).abs() < (first - frames).abs(), last, first)
        far = ends | ((first - last > GAP) & ~self.placed)
        reach = int(progress / CARRIED * int(distance.max()))
        late = far & (distance > reach)
        source = torch.where(late, nearest + (frames - nearest).sign() * reach, frames)
        pose = unknowns.pose
        pose = pose.replace(
            body=pose.body[source],
            global_orient=nearest_turn(pose.global_orient[source]),
            transl=pose.transl[source],
        )
        return replace(unknowns, pose=pose)

    def rescale(self, unknowns: Unknowns) -> Unknowns:
        """Take the scale from the ground at the feet; every camera sees the body where it was."""
        if not len(self.ground):
            return unknowns
        points = self.posed(unknowns, derivatives=False).points
        _, cam = self.in_cameras(points, unknowns.scale)
        feet = cam[:, [self.points.index(mark) for mark in FEET]].float()
        found = ground_scale(feet, self.ground, self.cameras, self.seen)
        if found is None:
            return unknowns
        scale, frames = found
        self.scale_from = f"scene points on the ground at the feet, {frames} frames"
        self.find_scale = False
        back = self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:]
        transl = unknowns.pose.transl + (unknowns.scale - scale) * back[..., 0]
        return Unknowns(
            unknowns.pose.replace(transl=transl), unknowns.offsets, unknowns.unit, scale
        )

    def measure(self, unknowns: Unknowns) -> None:
        """The size of the body, by the face's."""
        if self.found is not None or self.options.mean_size is not None:
            return
        points = self.posed(unknowns, derivatives=False).points
        _, cam = self.in_cameras(points, unknowns.scale)
        size, _ = self.kinematics.size(unknowns.pose.betas)
        self.size = Size.by_face(size, cam[:, self.points.index(NOSE), 2], self.faces)

    def estimate_motion(self, unknowns: Unknowns) -> None:
        """How strongly what the landmarks stand for accelerates."""
        if self.found is not None:
            return
        points = self.posed(unknowns, derivatives=False).points
        pixels, cam = self.in_cameras(points, unknowns.scale)
        # where the landmarks lie at the fit's depths, along the mean camera's two image axes
        metres = cam[..., 2:] / self.K[:, None, [0, 1], [0, 1]]
        axes = self.viewmats[:, :2, :3]
        places = points + (self.pixels - pixels) * metres @ axes
        self.motion.seen(places @ axes.mean(0).mT, self.visible > 0.5)

    def energy(
        self, unknowns: Unknowns, widen: float, equations: NormalEquations | None = None
    ) -> float:
        """Twice the negative logarithm of the posterior; its derivatives go into `equations`."""
        count, total = len(self.seen), 0.0
        for start in range(0, count, AT_ONCE):  # derivatives take 150 KB a frame
            total += self._part_of_energy(
                unknowns, widen, equations, start, min(start + AT_ONCE, count)
            )
        total += self.motion.angles(unknowns.pose, equations)
        share = (self.spacing / LASTS).clamp_max(1.0)
        total += float(self.prior.add(unknowns.pose.body.flatten(1), share, equations))
        total += self._shared_priors(unknowns, None if self.found else equations)
        if self.masks is not None:
            total += self.masks.energy(
                unknowns.pose, self._seen_at(unknowns.scale), widen, equations
            )
        if equations is not None and self.found is not None:
            equations.hold(self.found.frames)
        return total

    def _part_of_energy(
        self, unknowns: Unknowns, widen: float, equations: NormalEquations | None,
        start: int, stop: int,
    ) -> float:  # fmt: skip
        """Of landmarks in frames `start` to `stop`, and accelerations that begin in them."""
        own, further = slice(start, stop), slice(start, stop + REACH)
        at = self.posed(unknowns, equations is not None, further)
        shared = None if equations is None else self._by_shared(at)
        inner = equations and equations.of(further)
        total = self.motion.points(at, shared, unknowns.pose, start, inner)
        at, part, inner = at.first(stop - start), self.of(own), equations and equations.of(own)
        shared = None if shared is None else shared[: stop - start]
        total += part._landmarks(at, shared, unknowns, widen, inner)
        return total + part._in_space(at, shared, unknowns, widen, inner)

    def _seen_at(self, scale: float) -> Project:
        def project(points: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
            turn, shift = self.viewmats[frames, :3, :3], self.viewmats[frames, None, :3, 3]
            K, cam = self.K[frames], points @ turn.mT + scale * shift
            by_point = _by_place(K, cam) @ turn[:, None]
            return pinhole_pixels(K[:, None], cam, near=0.1), by_point

        return project

    def count_shared(self, unknowns: Unknowns) -> int:
        """Number of the unknowns that all frames share: 0 if they were found before."""
        return 0 if self.found else len(unknowns.pose.betas) + unknowns.offsets.numel() + 2

    def _by_shared(self, at: Posed) -> Float[Tensor, "F L 3 S"]:
        if self.found is not None:
            return at.points.new_zeros(*at.points.shape, 0)
        offsets = torch.einsum("flab,lpb->flapb", at.by_rest, self.onto_offsets).flatten(-2)
        scale = at.points.new_zeros(*at.points.shape, 2)
        return torch.cat((at.by_betas, offsets, scale), -1)

    def _landmarks(
        self, at: Posed, shared: Tensor | None, unknowns: Unknowns, widen: float,
        equations: NormalEquations | None,
    ) -> float:  # fmt: skip
        pixels, cam = self.in_cameras(at.points, unknowns.scale)
        residuals = pixels - self.pixels
        squares = residuals.square().sum(-1) / self.noise**2
        cost, weight = robust_weights(squares, widen)
        if equations is not None and shared is not None:
            by_point = _by_place(self.K, cam)
            turned = by_point @ self.viewmats[:, None, :3, :3]
            by_shared = turned @ shared
            if self.find_scale:
                by_shared[..., -1] = (by_point @ self.viewmats[:, None, :3, 3:])[..., 0]
            weight = self.visible * weight / self.noise**2
            equations.add(
                residuals.flatten(1), weight[..., None].expand_as(residuals).flatten(1),
                (turned @ at.by_frame).flatten(1, 2), by_shared.flatten(1, 2),
            )  # fmt: skip
        return float((self.visible * cost).sum())

    def _in_space(
        self, at: Posed, shared: Tensor | None, unknowns: Unknowns, widen: float,
        equations: NormalEquations | None,
    ) -> float:  # fmt: skip
        """The 3D landmarks, about an origin of each frame's own, along the camera's axes."""
        residuals, weight, cost = self._space_residuals(at.points, unknowns.unit, widen)
        if equations is not None and shared is not None:
            turn = self.viewmats[:, None, :3, :3]
            weight = (weight / self.spread**2)[..., None].expand_as(residuals)
            total = weight.sum(1, keepdim=True).clamp_min(1e-12)
            size = 1 + unknowns.unit
            shared = size * turn @ shared
            if self.found is None:
                shared[..., -2] = (turn @ at.points[..., None])[..., 0]

            def about_origin(by: Tensor) -> Tensor:
                mean = (weight[..., None] * by).sum(1, keepdim=True) / total[..., None]
                return (by - mean).flatten(1, 2)

            equations.add(
                residuals.flatten(1), weight.flatten(1),
                about_origin(size * turn @ at.by_frame), about_origin(shared),
            )  # fmt: skip
        return float((self.in_space * cost).sum())

    def _space_residuals(
        self, points: Float[Tensor, "F L 3"], unit: float, widen: float
    ) -> tuple[Float[Tensor, "F L 3"], Float[Tensor, "F L"], Float[Tensor, "F L"]]:
        """Residuals of the 3D landmarks with the origins that fit best, their weights and cost."""
        off = (1 + unit) * points @ self.viewmats[:, :3, :3].mT - self.space
        weight = self.in_space
        for _ in range(REWEIGHTINGS):
            share = weight[..., None]
            total = share.sum(1, keepdim=True).clamp_min(1e-12)
            origin = (share * off).sum(1, keepdim=True) / total
            residuals = off - origin
            squares = residuals.square().sum(-1) / self.spread**2
            cost, robust = robust_weights(squares, widen)
            weight = self.in_space * robust
        return residuals, weight, cost

    def _shared_priors(self, unknowns: Unknowns, equations: NormalEquations | None) -> float:
        """Cost of shape, size, offsets and unit, twice the negative logarithm of their density.

        Offsets count in parts of the body's size. In metres, those that landmarks have by
        definition would be cheaper on a smaller body closer by.
        """
        mean = self.size.mean
        betas = unknowns.pose.betas
        unit = self.offset_spread.new_tensor([unknowns.unit - (1 / mean - 1)])
        size, by_betas = self.kinematics.size(betas)
        spread = self.offset_spread.repeat_interleave(3) * size
        shape = torch.full_like(betas, self.options.shape)
        spreads = torch.cat((shape, spread, torch.full_like(unit, self.options.unit)))
        values = torch.cat((betas - self.shape, unknowns.offsets.flatten(), unit)) / spreads
        larger = (size - mean) / self.options.size
        if equations is not None:
            derivatives = torch.diag(spreads.reciprocal())
            offsets = slice(len(betas), -1)
            derivatives[offsets, : len(betas)] = -values[offsets, None] * by_betas / size
            equations.by_shared[:-1] += derivatives.mT @ values
            equations.shared[:-1, :-1] += derivatives.mT @ derivatives
            by_size = by_betas / self.options.size
            equations.by_shared[: len(betas)] += by_size * larger
            equations.shared[: len(betas), : len(betas)] += torch.outer(by_size, by_size)
        return float(values.square().sum()) + larger**2

    def joints(self, unknowns: Unknowns) -> Float[Tensor, "F 22 3"]:
        """The body's joints along the cameras' axes."""
        _, joints = self.kinematics.placed(unknowns.pose)
        return self.in_cameras(joints, unknowns.scale)[1]

    def misses(self, unknowns: Unknowns) -> Float[Tensor, "F L"]:
        """Distances of the visible landmarks in the image, pixels; NaN of the others."""
        points = self.posed(unknowns, derivatives=False).points
        pixels, _ = self.in_cameras(points, unknowns.scale)
        distance = (pixels - self.pixels).norm(dim=-1).float()
        return distance.masked_fill(self.visible <= 0.5, torch.nan)

    def result(
        self, unknowns: Unknowns, misses: Float[Tensor, "F L"], errors: BodyErrors
    ) -> BodyFit:
        """Pose and report, of the unknowns of all frames, their `misses` and errors."""
        mean = float(misses.nanmean())
        report = {
            "landmark_error_px": round(mean, 2),
            "landmark_error_px_median": round(float(misses.nanmedian()), 2),
            "landmark_error_px_at_1280": round(mean * 1280 / self.width, 2),
            "landmark_noise_px": round(self.noise, 2),
            "landmark_unit": round(1 + unknowns.unit, 3),
            "size": round(self.size.mean, 3),
            "size_spread": round(self.size.spread, 3),
            "size_from": self.size.source,
            "landmark_offset_m_largest": round(float(unknowns.offsets.norm(dim=-1).max()), 3),
            "frames_with_landmarks": int(self.seen.sum()),
            "frames_with_landmarks_in_space": self.solid,
            "frames": len(misses),
            "scene_scale": round(float(unknowns.scale), 5),
            "scene_scale_from": self.scale_from,
        }
        pose = unknowns.pose.map(lambda x: x.float())
        return BodyFit(pose, misses.nanmean(1), unknowns.scale, report, errors)


def _by_place(K: Float[Tensor, "F 3 3"], cam: Float[Tensor, "F L 3"]) -> Float[Tensor, "F L 2 3"]:
    """Pixels by the places along the camera's axes; none nearer than in `pinhole_pixels`."""
    z = cam[..., 2].clamp_min(0.1)
    fx, fy = K[:, None, 0, 0] / z, K[:, None, 1, 1] / z
    none = torch.zeros_like(fx)
    rows = (fx, none, -fx * cam[..., 0] / z, none, fy, -fy * cam[..., 1] / z)
    return torch.stack(rows, -1).unflatten(-1, (2, 3))
