"""The energy of the body fit: its unknowns, its terms and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera, pinhole_pixels
from hoigs.preparation.body.fit_values import BodyFit, FitOptions, Found, Unknowns
from hoigs.preparation.body.ground_scale import ground_scale
from hoigs.preparation.body.kinematics import Kinematics, Posed, nearest_turn
from hoigs.preparation.body.landmarks import FEET, TORSO, LandmarkPoints, Landmarks, points_of
from hoigs.preparation.body.mask_fit import MaskFit, Masks, Project
from hoigs.preparation.body.normal_equations import REACH, NormalEquations
from hoigs.preparation.body.priors import REST_LASTS as LASTS
from hoigs.preparation.body.priors import MotionPrior, Noise, PosePrior, robust_weights
from hoigs.preparation.body.start import Start, first_guess

GAP = 12  # frames between landmarks that smoothness carries a pose across
CARRIED = 0.6  # of the steps, in which frames farther off begin one after another
SURFACE = 1.7  # of a landmark on the skin against one at a joint: how uncertain its place is
REWEIGHTINGS = 3  # for the 3D landmarks' origin
AT_ONCE = 256  # frames whose derivatives are in memory
ALL = slice(None)
OF_FRAMES = ("visible", "pixels", "K", "viewmats", "in_space", "space")
LEAST_PIXELS = 3e-3  # of the width: no landmark is known better


class FitProblem:
    """The energy and what it needs, precomputed.

    Args:
        times: of the frames, seconds.
        turns: axis-angle of joints 1..21 where they are known, about.
        start: where the fit begins, in place of `first_guess`.
        found: what another fit has found, and this one keeps.
    """

    def __init__(
        self,
        body: BodyModel,
        landmarks: Landmarks,
        cameras: Sequence[Camera],
        times: Float[Tensor, " F"],
        options: FitOptions,
        turns: Float[Tensor, "F 21 3"] | None = None,
        start: Start | None = None,
        found: Found | None = None,
    ) -> None:
        self.body, self.options, self.found = body, options, found
        self.points: LandmarkPoints = points_of(body)
        self.kinematics = Kinematics(body, self.points.joints, self.points.vertices)
        rows = list(self.points.landmarks)
        self.seen: Bool[Tensor, " F"] = landmarks.found
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
        steps = (times[1:] - times[:-1]).double().clamp_min(1e-4)
        apart = torch.nn.functional.pad(steps, (1, 1), value=float(steps.median()))
        self.spacing = 0.5 * (apart[1:] + apart[:-1])  # seconds that each frame stands for
        self.prior = PosePrior(turns)
        torso = [self.points.index(mark) for mark in TORSO]
        self.motion = MotionPrior(self.kinematics, torso, len(rows), times, options.smooth)
        pairs = int(self.points.pairs.max()) + 1
        onto = torch.nn.functional.one_hot(self.points.pairs, pairs).double()
        self.onto_offsets = (onto[:, :, None] * self.points.mirror[:, None]).double()  # [L, P, 3]
        surface = (onto[len(self.points.joints) :].sum(0) > 0).double()
        self.offset_spread = options.offset * (1 + (SURFACE - 1) * surface)
        self.noise = Noise(
            torch.full((len(rows),), options.spread * self.width, dtype=torch.float64),
            torch.full((len(rows), 3), options.space, dtype=torch.float64),
        )
        start = start or first_guess(body, landmarks, cameras, options.scale)
        if turns is not None:
            start = replace(start, body=turns)
        self.begin = Unknowns.start(start, body.num_betas, pairs)
        self.placed = self.seen.clone()  # frames that the others follow
        if found is not None:
            self.noise, self.begin = found.noise, found.begin(self.begin)
            self.placed[: found.frames] = True
            self.motion.suppose(found.ordinary)

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

    def estimate_noise(self, unknowns: Unknowns) -> None:
        """Of the landmarks; and how strongly what they stand for accelerates."""
        if self.found is not None:
            return
        points = self.posed(unknowns, derivatives=False).points
        pixels, cam = self.in_cameras(points, unknowns.scale)
        residuals, _, _ = self._space_residuals(points, unknowns.unit, 1.0)
        self.noise = self.noise.seen(
            (pixels - self.pixels, self.visible),
            (residuals, self.in_space),
            LEAST_PIXELS * self.width,
        )
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
        squares = residuals.square().sum(-1) / self.noise.pixels.square()
        cost, weight = robust_weights(squares, widen)
        if equations is not None and shared is not None:
            by_point = _by_place(self.K, cam)
            turned = by_point @ self.viewmats[:, None, :3, :3]
            by_shared = turned @ shared
            if self.find_scale:
                by_shared[..., -1] = (by_point @ self.viewmats[:, None, :3, 3:])[..., 0]
            weight = self.visible * weight / self.noise.pixels.square()
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
            weight = weight[..., None] / self.noise.space.square()
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
            share = weight[..., None] / self.noise.space.square()
            origin = (share * off).sum(1, keepdim=True) / share.sum(1, keepdim=True).clamp_min(
                1e-12
            )
            residuals = off - origin
            squares = (residuals / self.noise.space).square().sum(-1)
            cost, robust = robust_weights(squares, widen)
            weight = self.in_space * robust
        return residuals, weight, cost

    def _shared_priors(self, unknowns: Unknowns, equations: NormalEquations | None) -> float:
        """Cost of shape, size, offsets and unit, twice the negative logarithm of their density.

        Offsets count in parts of the body's size. In metres, those that landmarks have by
        definition would be cheaper on a smaller body closer by.
        """
        mean = self.options.mean_size
        betas = unknowns.pose.betas
        unit = self.offset_spread.new_tensor([unknowns.unit - (1 / mean - 1)])
        size, by_betas = self.kinematics.size(betas)
        spread = self.offset_spread.repeat_interleave(3) * size
        shape = torch.full_like(betas, self.options.shape)
        spreads = torch.cat((shape, spread, torch.full_like(unit, self.options.unit)))
        values = torch.cat((betas, unknowns.offsets.flatten(), unit)) / spreads
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

    def misses(self, unknowns: Unknowns) -> Float[Tensor, "F L"]:
        """Distances of the visible landmarks in the image, pixels; NaN of the others."""
        points = self.posed(unknowns, derivatives=False).points
        pixels, _ = self.in_cameras(points, unknowns.scale)
        distance = (pixels - self.pixels).norm(dim=-1).float()
        return distance.masked_fill(self.visible <= 0.5, torch.nan)

    def result(self, unknowns: Unknowns, misses: Float[Tensor, "F L"]) -> BodyFit:
        """Pose and report, of the unknowns of all frames and their `misses`."""
        mean = float(misses.nanmean())
        report = {
            "landmark_error_px": round(mean, 2),
            "landmark_error_px_median": round(float(misses.nanmedian()), 2),
            "landmark_error_px_at_1280": round(mean * 1280 / self.width, 2),
            "landmark_noise_px": round(float(self.noise.pixels.median()), 2),
            "landmark_noise_m": round(float(self.noise.space.median()), 3),
            "landmark_unit": round(1 + unknowns.unit, 3),
            "landmark_offset_m_largest": round(float(unknowns.offsets.norm(dim=-1).max()), 3),
            "frames_with_landmarks": int(self.seen.sum()),
            "frames_with_landmarks_in_space": self.solid,
            "frames": len(misses),
            "scene_scale": round(float(unknowns.scale), 5),
            "scene_scale_from": self.scale_from,
        }
        pose = unknowns.pose.map(lambda x: x.float())
        return BodyFit(pose, misses.nanmean(1), unknowns.scale, report)


def _by_place(K: Float[Tensor, "F 3 3"], cam: Float[Tensor, "F L 3"]) -> Float[Tensor, "F L 2 3"]:
    """Pixels by the places along the camera's axes; none nearer than in `pinhole_pixels`."""
    z = cam[..., 2].clamp_min(0.1)
    fx, fy = K[:, None, 0, 0] / z, K[:, None, 1, 1] / z
    none = torch.zeros_like(fx)
    rows = (fx, none, -fx * cam[..., 0] / z, none, fy, -fy * cam[..., 1] / z)
    return torch.stack(rows, -1).unflatten(-1, (2, 3))
