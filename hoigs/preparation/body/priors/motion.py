"""How a body moves before it is seen: accelerations of its points and joint angles, per second."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.kinematics import JOINTS, Kinematics, Posed
from hoigs.preparation.body.normal_equations import NormalEquations
from hoigs.preparation.body.priors.acceleration_spread import acceleration_spreads

TURNING = 30.0  # rad/s^2 of a joint: CMU's basketball players, 6 to 100
ORDINARY = 6.0  # m/s^2 of the points that such a joint moves
SLOWEST, FASTEST = 10.0, 150.0  # rad/s^2: no joint is taken to turn slower or faster
LASTS = 0.06  # seconds in which an acceleration stays what it is: CMU's basketball players
INDEPENDENT = 0.4  # share of the points that move by themselves
FAT = 4.0  # degrees of freedom of Student's distribution of accelerations


class MotionPrior:
    """Accelerations by Student's distribution (Lange, Little and Taylor 1989): ordinary motion is
    held, a throw let go. Angles of joints by a normal one. What is ordinary is estimated for each
    point from its landmark (`seen`): a torso that stands still steadies the body's distance, which
    one image hardly shows, and hands are free to do what they do.

    Points count about the torso's middle, and that as one more: a body that moves as a whole has
    one acceleration, not one a point.

    Args:
        torso: numbers of points. count: of all points.
        times: of the frames, seconds.
        smooth: acceleration that is ordinary before anything was seen, m/s^2.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        torso: list[int],
        count: int,
        times: Float[Tensor, " F"],
        smooth: float,
    ) -> None:
        self.kinematics, self.torso = kinematics, torso
        self.ordinary = torch.full((count + 1,), smooth, dtype=torch.float64)
        self.turning = torch.full((3 * JOINTS - 3,), TURNING, dtype=torch.float64)
        steps = (times[1:] - times[:-1]).double().clamp_min(1e-4)
        self.factors = _second_differences(steps)
        self.lasts = (0.5 * (steps[1:] + steps[:-1]) / LASTS).clamp_max(1.0)[:, None]
        self.independent = torch.full((count + 1,), INDEPENDENT, dtype=torch.float64)
        self.independent[-1] = 1.0

    def seen(self, places: Float[Tensor, "F L C"], known: Bool[Tensor, "F L"]) -> None:
        """Estimate what is ordinary anew.

        Args:
            places: of the landmarks, metres, along axes in which depth plays no part.
        """
        torso = known[:, self.torso].all(1, keepdim=True)
        known = torch.cat((known & torso, torso), 1)
        about = self._about_torso(places)
        self.suppose(acceleration_spreads(about, known, self.factors, self.ordinary))

    def suppose(self, ordinary: Float[Tensor, " K"]) -> None:
        """Take these accelerations of points for ordinary, and joints to turn accordingly."""
        self.ordinary = ordinary
        moved = (self.kinematics.weights @ self.kinematics.below.mT > 0.5).double()  # [L, joints]
        share = moved / moved.sum(0).clamp_min(1)
        ratio = (self.ordinary[:-1] @ share)[1:] / ORDINARY
        ratio = torch.where(moved.any(0)[1:], ratio, 1.0)
        self.turning = (TURNING * ratio).clamp(SLOWEST, FASTEST).repeat_interleave(3)

    def points(
        self, at: Posed, shared: Tensor | None, pose: BodyPose, start: int,
        equations: NormalEquations | None,
    ) -> float:  # fmt: skip
        """Cost of the points' accelerations, twice the negative logarithm of the density; adds to
        the equations, if any.

        Args:
            at: the points of some frames from `start` on; their equations are `equations`.
        """
        if len(at.points) < 3:
            return 0.0
        # a small body close by would accelerate less than a large one far off in the same images
        size, by_betas = self.kinematics.size(pose.betas)
        rows = slice(start, start + len(at.points) - 2)
        factors, share = self.factors[rows] / size, self.lasts[rows] * self.independent
        points = self._about_torso(at.points)
        values = _differences(points.flatten(1), factors).unflatten(1, (-1, 3))
        squares = values.square().sum(-1) / self.ordinary.square()
        cost = share * (FAT + 3) * (1 + squares / FAT).log()
        if equations is not None and shared is not None:
            weight = share * (FAT + 3) / (FAT + squares) / self.ordinary.square()
            shrinking = points[..., None] * by_betas / size
            shared = self._about_torso(shared) - torch.nn.functional.pad(
                shrinking, (0, shared.shape[-1] - len(by_betas))
            )
            equations.add_accelerations(
                values.flatten(1), weight[..., None].expand_as(values).flatten(1), factors,
                self._about_torso(at.by_frame).flatten(1, 2), shared.flatten(1, 2),
            )  # fmt: skip
        return float(cost.sum())

    def angles(self, pose: BodyPose, equations: NormalEquations | None) -> float:
        """Cost of the joints' accelerations in all frames, likewise."""
        if len(pose.body) < 3:
            return 0.0
        factors, weight = self.factors, INDEPENDENT * self.lasts / self.turning.square()
        turning = _differences(pose.body.flatten(1), factors)
        if equations is not None:
            count = len(turning)
            for a in range(3):
                part = weight * factors[:, a, None]
                equations.by_frame[a : a + count, 6:] += part * turning
                for b in range(a, 3):
                    diagonal = equations.blocks[b - a].diagonal(dim1=1, dim2=2)
                    diagonal[a : a + count, 6:] += part * factors[:, b, None]
        return float((weight * turning.square()).sum())

    def _about_torso(self, values: Float[Tensor, "F L *rest"]) -> Float[Tensor, "F K *rest"]:
        middle = values[:, self.torso].mean(1, keepdim=True)
        return torch.cat((values - middle, middle), 1)


def _differences(
    values: Float[Tensor, "F N"], factors: Float[Tensor, "T 3"]
) -> Float[Tensor, "T N"]:
    count = len(factors)
    first, second, third = (values[k : k + count] * factors[:, k, None] for k in range(3))
    return first + second + third


def _second_differences(steps: Float[Tensor, " S"]) -> Float[Tensor, "T 3"]:
    """Factors of the values at three times that give their second derivative."""
    before, after = steps[:-1], steps[1:]
    span = 0.5 * (before + after)
    return torch.stack(
        (1 / (before * span), -1 / before / span - 1 / after / span, 1 / (after * span)), 1
    )
