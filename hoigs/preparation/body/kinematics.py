"""Points on a posed body and their derivatives by its pose, in closed form."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.maths.skinning import ancestor_table
from hoigs.core.values.moment import BodyPose

JOINTS = 22  # SMPL-X's body joints; hands, jaw and eyes move with the joint that carries them
PER_FRAME = 3 + 3 * JOINTS  # transl, then one rotation a joint


@dataclass(frozen=True)
class Posed:
    """Points in the world, metres, with their derivatives.

    Attributes:
        by_frame: by the frame's own unknowns: transl, a turn of the root about the body's own axes
            after `global_orient`'s, and the axis-angles of joints 1..21; radians.
        by_betas: by the shape coefficients. by_rest: by the points' rest positions.
    """

    points: Float[Tensor, "F L 3"]
    by_frame: Float[Tensor, "F L 3 N"]
    by_betas: Float[Tensor, "F L 3 B"]
    by_rest: Float[Tensor, "F L 3 3"]

    def first(self, frames: int) -> Posed:
        """Of the first frames alone."""
        parts = (self.points, self.by_frame, self.by_betas, self.by_rest)
        return Posed(*(part[:frames] for part in parts))


class Kinematics:
    """Points that are bound to a body, by linear blend skinning over its 22 body joints.

    In float64: normal equations square the condition of their matrix. Shape directions are taken
    for linear, as in SMPL; pose blendshapes are left out.

    Args:
        joints: joints that are points, each carried by the bone above it.
        vertices: vertices that are the points after them.
    """

    def __init__(
        self, body: BodyModel, joints: Int[Tensor, " A"], vertices: Int[Tensor, " B"]
    ) -> None:
        parents = [min(parent, JOINTS - 1) for parent in body.parents]
        self.parents = parents[:JOINTS]
        nothing = torch.zeros(body.num_betas)
        shapes = [body.shaped(row) for row in (nothing, *torch.eye(body.num_betas))]
        rest = torch.stack([torch.cat((j[joints], v[vertices])) for v, j in shapes]).double()
        tree = torch.stack([j[:JOINTS] for _, j in shapes]).double()
        self.rest, self.rest_by_betas = rest[0], rest[1:] - rest[0]
        self.joints, self.joints_by_betas = tree[0], tree[1:] - tree[0]
        ancestors = ancestor_table(body.parents)  # [joint, ancestor]
        carrier = _last_body_joint(body.parents)
        onto = torch.nn.functional.one_hot(carrier, JOINTS).double()
        above = onto[torch.tensor([body.parents[j] for j in joints.tolist()], dtype=torch.long)]
        skin = body.skinning_weights[vertices].double() @ onto
        self.weights = torch.cat((above, skin))  # [L, 22]
        self.below = ancestors[:JOINTS, :JOINTS].double().T  # [joint, its descendants]

    def posed(self, pose: BodyPose, shift: Float[Tensor, "L 3"], derivatives: bool = True) -> Posed:
        """The points at a batched pose with one shape.

        Args:
            shift: of the points in the rest pose, metres.
        """
        betas = pose.betas.double()
        turns = torch.cat((pose.global_orient[:, None], pose.body), 1).double()
        joints = self._at_rest(betas)
        rest = self.rest + torch.einsum("b,blc->lc", betas, self.rest_by_betas) + shift
        world, places = self.placed(pose)
        # every point as each of its joints alone would carry it, times that joint's weight
        arms = rest[:, None] - joints  # [L, 22, 3]
        carried = torch.einsum("fjab,ljb->flja", world, arms) + places[:, None]
        weighted = self.weights[..., None] * carried
        points = weighted.sum(2)
        if not derivatives:
            none = points.new_zeros(0)
            return Posed(points, none, none, none)
        share = self.weights @ self.below.T  # [L, 22]: of a point that a joint turns
        lever = torch.einsum("jk,flkc->fljc", self.below, weighted)
        lever = lever - share[..., None] * places[:, None]
        axes = world.clone()
        axes[:, 1:] = world[:, 1:] @ right_jacobian(turns[:, 1:])
        by_turns = torch.linalg.cross(
            axes[:, None].mT.expand(-1, len(rest), -1, -1, -1), lever[..., None, :], dim=-1
        )  # [F, L, 22, axis, 3]
        by_turns = by_turns.flatten(2, 3).mT
        still = torch.eye(3).to(points).expand(*points.shape[:2], 3, 3)
        blended = torch.einsum("lj,fjab->flab", self.weights, world)
        return Posed(
            points, torch.cat((still, by_turns), -1), self._by_betas(world, blended), blended
        )

    def placed(self, pose: BodyPose) -> tuple[Float[Tensor, "F 22 3 3"], Float[Tensor, "F 22 3"]]:
        """Rotation and place of each joint in the world, at a batched pose with one shape."""
        turns = torch.cat((pose.global_orient[:, None], pose.body), 1).double()
        joints = self._at_rest(pose.betas.double())
        return self._chain(axis_angle_to_matrices(turns), joints, pose.transl.double())

    def _at_rest(self, betas: Float[Tensor, " B"]) -> Float[Tensor, "22 3"]:
        return self.joints + torch.einsum("b,bjc->jc", betas, self.joints_by_betas)

    def size(self, betas: Float[Tensor, " B"]) -> tuple[float, Float[Tensor, " B"]]:
        """Root mean square bone length in parts of the mean body's; its derivatives by betas."""
        parents = torch.tensor(self.parents[1:])
        bones = self.joints[1:] - self.joints[parents]
        changes = self.joints_by_betas[:, 1:] - self.joints_by_betas[:, parents]
        mean = bones.norm()
        now = bones + torch.einsum("b,bjc->jc", betas, changes)
        size = now.norm().clamp_min(0.05 * mean)
        return float(size / mean), torch.einsum("jc,bjc->b", now, changes) / (size * mean)

    def _chain(
        self, local: Float[Tensor, "F 22 3 3"], joints: Float[Tensor, "22 3"], transl: Tensor
    ) -> tuple[Float[Tensor, "F 22 3 3"], Float[Tensor, "F 22 3"]]:
        """Rotation and place of each joint in the world."""
        turns, places = [local[:, 0]], [joints[0] + transl]
        for joint in range(1, JOINTS):
            parent = self.parents[joint]
            turns.append(turns[parent] @ local[:, joint])
            places.append(places[parent] + turns[parent] @ (joints[joint] - joints[parent]))
        return torch.stack(turns, 1), torch.stack(places, 1)

    def _by_betas(self, world: Tensor, blended: Tensor) -> Float[Tensor, "F L 3 B"]:
        shift = self.joints_by_betas.permute(1, 2, 0)  # [22, 3, B]
        places = [shift[0].expand(len(world), -1, -1)]
        for joint in range(1, JOINTS):
            parent = self.parents[joint]
            places.append(places[parent] + world[:, parent] @ (shift[joint] - shift[parent]))
        off = torch.stack(places, 1) - world @ shift
        of_joints = torch.einsum("lj,fjcb->flcb", self.weights, off)
        return of_joints + blended @ self.rest_by_betas.permute(1, 2, 0)


def _last_body_joint(parents: tuple[int, ...]) -> Int[Tensor, " J"]:
    """Of each joint, the nearest of the 22 body joints at or above it."""
    found: list[int] = []
    for joint, parent in enumerate(parents):
        found.append(joint if joint < JOINTS else found[parent])
    return torch.tensor(found)


def right_jacobian(turns: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """J with Exp(v + d) = Exp(v) Exp(J d) to first order (Chirikjian 2012, eq. 10.86)."""
    angle = turns.norm(dim=-1)[..., None, None].clamp_min(1e-4)
    x, y, z = turns.unbind(-1)
    none = torch.zeros_like(x)
    cross = torch.stack((none, -z, y, z, none, -x, -y, x, none), -1).unflatten(-1, (3, 3))
    first = (1 - angle.cos()) / angle.square()
    second = (angle - angle.sin()) / angle.pow(3)
    return torch.eye(3).to(turns) - first * cross + second * cross @ cross


def nearest_turn(turns: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """The same rotations as axis-angles without jumps between frames; angles may exceed pi."""
    found = turns.clone()
    for i in range(1, len(found)):
        angle = found[i].norm().clamp_min(1e-9)
        rounds = 2 * math.pi * found[i] / angle
        choices = torch.stack([found[i] + k * rounds for k in (-1, 0, 1)])
        found[i] = choices[(choices - found[i - 1]).norm(dim=-1).argmin()]
    return found


REACH = 2  # frames that an acceleration couples a frame to


class NormalEquations:
    """H x = -g, with H block-banded in the frames and bordered by the shared unknowns.

    Attributes:
        blocks: of frame t with frame t + d, for d = 0, 1, 2. border: of each frame with the shared
            unknowns. shared: of these with one another. by_frame, by_shared: the gradient.
    """

    def __init__(self, frames: int, width: int, shared: int) -> None:
        double = torch.float64
        self.blocks = [
            torch.zeros(max(frames - d, 0), width, width, dtype=double) for d in range(REACH + 1)
        ]
        self.border = torch.zeros(frames, width, shared, dtype=double)
        self.shared = torch.zeros(shared, shared, dtype=double)
        self.by_frame = torch.zeros(frames, width, dtype=double)
        self.by_shared = torch.zeros(shared, dtype=double)

    def of(self, frames: slice) -> NormalEquations:
        """A view of some frames' part: what is added to it is added to these."""
        part = copy(self)
        first, last, _ = frames.indices(len(self.by_frame))
        part.blocks = [block[first : max(last - d, first)] for d, block in enumerate(self.blocks)]
        part.border, part.by_frame = self.border[first:last], self.by_frame[first:last]
        return part

    def add(
        self,
        residuals: Float[Tensor, "F R"],
        weights: Float[Tensor, "F R"],
        by_frame: Float[Tensor, "F R N"],
        by_shared: Float[Tensor, "F R S"],
    ) -> None:
        """Residuals of single frames: half the sum of weights times their squares."""
        weighted = by_frame.mT * weights[:, None]
        self.blocks[0] += weighted @ by_frame
        self.border += weighted @ by_shared
        self.by_frame += (weighted @ residuals[..., None])[..., 0]
        self._add_shared(residuals, weights, by_shared)

    def add_accelerations(
        self,
        residuals: Float[Tensor, "T R"],
        weights: Float[Tensor, "T R"],
        factors: Float[Tensor, "T 3"],
        by_frame: Float[Tensor, "F R N"],
        by_shared: Float[Tensor, "F R S"],
    ) -> None:
        """Residuals that are, of frames t, t + 1 and t + 2, a sum of values times `factors`."""
        count = len(residuals)
        parts = [by_frame[k : k + count] * factors[:, k, None, None] for k in range(3)]
        shared = torch.stack(
            [by_shared[k : k + count] * factors[:, k, None, None] for k in range(3)]
        ).sum(0)
        for a in range(3):
            weighted = parts[a].mT * weights[:, None]
            self.border[a : a + count] += weighted @ shared
            self.by_frame[a : a + count] += (weighted @ residuals[..., None])[..., 0]
            for b in range(a, 3):
                self.blocks[b - a][a : a + count] += weighted @ parts[b]
        self._add_shared(residuals, weights, shared)

    def take(self, others: NormalEquations, frames: Int[Tensor, " K"]) -> None:
        """Adds those of residuals of single frames, some of these."""
        self.blocks[0][frames] += others.blocks[0]
        self.border[frames] += others.border
        self.by_frame[frames] += others.by_frame
        self.shared += others.shared
        self.by_shared += others.by_shared

    def hold(self, frames: int) -> None:
        """Leave the unknowns of the first frames as they are."""
        self.by_frame[:frames], self.border[:frames] = 0, 0
        for block in self.blocks:
            block[:frames] = 0
        self.blocks[0][:frames] = torch.eye(self.by_frame.shape[1]).to(self.by_frame)

    def _add_shared(self, residuals: Tensor, weights: Tensor, by_shared: Tensor) -> None:
        flat = by_shared.flatten(0, 1)
        weighted = flat * weights.flatten()[:, None]
        self.shared += weighted.T @ flat
        self.by_shared += weighted.T @ residuals.flatten()

    def step(self, damping: float) -> tuple[Float[Tensor, "F N"], Float[Tensor, " S"]] | None:
        """The step to the minimum (Levenberg 1944, Marquardt 1963), of frames and shared unknowns.

        Args:
            damping: share of the diagonal that is added to it.

        Returns:
            None if the matrix is not positive definite.
        """
        frames, width = self.by_frame.shape
        band = self._band(damping)
        right = torch.cat((self.by_frame[..., None], self.border), -1).reshape(frames * width, -1)
        try:
            factor = cholesky_banded(band, overwrite_ab=True, check_finite=False)
        except LinAlgError:
            return None
        solved = torch.from_numpy(cho_solve_banded((factor, False), right.numpy()))
        border = self.border.flatten(0, 1)
        left = self.shared + torch.diag(damping * self.shared.diagonal() + 1e-9)
        left = left - border.T @ solved[:, 1:]
        down, problem = torch.linalg.solve_ex(left, border.T @ solved[:, 0] - self.by_shared)
        if int(problem) != 0:
            return None
        step = -(solved[:, 0] + solved[:, 1:] @ down).unflatten(0, (frames, width))
        return (step, down) if bool(torch.isfinite(step).all()) else None

    def draws(
        self, count: int, generator: torch.Generator
    ) -> Iterator[tuple[Float[Tensor, "F N"], Float[Tensor, " S"]]]:
        """Drawn from the normal distribution whose inverse covariance H is, of frames and shared
        unknowns (Rue and Held 2005, algorithm 2.4, with the border's by its Schur complement).

        Raises:
            LinAlgError: numpy's or torch's: H is not positive definite.
        """
        frames, width = self.by_frame.shape
        factor = cholesky_banded(self._band(0.0), overwrite_ab=True, check_finite=False)
        border = self.border.flatten(0, 1)
        solved = torch.from_numpy(cho_solve_banded((factor, False), border.numpy()))
        left = torch.linalg.cholesky(
            self.shared + 1e-9 * torch.eye(len(self.shared)).double() - border.T @ solved
        )
        normal = partial(torch.randn, generator=generator, dtype=torch.float64)
        for _ in range(count):
            own, _ = dtbtrs(factor, normal(frames * width, 1).numpy())
            shared = torch.linalg.solve_triangular(left.mT, normal(len(left), 1), upper=True)
            own = torch.from_numpy(own) - solved @ shared
            yield own.view(frames, width), shared[:, 0]

    def _band(self, damping: float) -> Float[np.ndarray, "K M"]:
        """Upper diagonals of the frames' part, as LAPACK stores them."""
        frames, width = self.by_frame.shape
        reach = (REACH + 1) * width - 1
        band = np.zeros((reach + 1, frames * width), order="F")  # LAPACK's, or it is copied
        row, column = np.meshgrid(np.arange(width), np.arange(width), indexing="ij")
        for d, blocks in enumerate(self.blocks):
            upper = row <= column if d == 0 else np.ones_like(row, bool)
            down = (reach + row - column - d * width)[upper]
            for t, block in enumerate(blocks.numpy()):
                band[down, (column + (t + d) * width)[upper]] = block[upper]
        band[reach] *= 1 + damping
        band[reach] += 1e-9
        return band
