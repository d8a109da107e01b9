"""What is known of bodies before they are seen: rest pose, limits of joints and motion."""

from __future__ import annotations

import functools
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.kinematics import JOINTS, Kinematics, NormalEquations, Posed
from hoigs.preparation.body.start import relaxed

# How strongly each point of a body accelerates in a clip, estimated from noisy places of it.

AT_ONCE = 256  # accelerations that are decorrelated together
FEWEST = 16  # accelerations that an estimate needs
RATIOS = torch.logspace(0.5, 5, 46, dtype=torch.float64)  # of accelerations to noise, 1/s^2
SLOWEST_POINT, FASTEST_POINT = 3.0, 60.0  # m/s^2: a throw after a long rest is not held still
JITTERY, JITTER = 1.5, 16.0  # of the points' median noise; least acceleration from there on, m/s^2


def acceleration_spreads(
    places: Float[Tensor, "F K C"],
    known: Bool[Tensor, "F K"],
    factors: Float[Tensor, "T 3"],
    otherwise: Float[Tensor, " K"],
) -> Float[Tensor, " K"]:
    """Standard deviations of accelerations, a component, m/s^2.

    Second differences of places that were measured with white noise are accelerations plus noise
    of a known spectrum. The most probable ratio of the two is searched for, and the noise follows
    (restricted maximum likelihood, Patterson and Thompson 1971). A point that jitters more than
    most may be measured worse, or jolted; it is not held stiller than `JITTER`.

    Args:
        places: metres. factors: of three places that give their second derivative, 1/s^2.
        otherwise: of points that are known in too few frames.
    """
    spreads = otherwise.clone()
    noise = torch.full_like(spreads, torch.nan)
    alike, group = torch.unique(known, dim=1, return_inverse=True)
    for number, frames in enumerate(alike.T):  # one decomposition for points of the same frames
        points = (group == number).nonzero()[:, 0]
        by_noise, squares = _spectrum(places[:, points], frames, factors)
        if len(by_noise) < FEWEST:
            continue
        for point, column in zip(points.tolist(), squares.T, strict=True):
            if column.any():
                spreads[point], noise[point] = _most_probable(by_noise, column)
    spreads = spreads.clamp(SLOWEST_POINT, FASTEST_POINT)
    jittery = noise > JITTERY * noise.nanmedian()
    return torch.where(jittery, spreads.clamp_min(JITTER), spreads)


def _spectrum(
    places: Float[Tensor, "F K C"], known: Bool[Tensor, " F"], factors: Float[Tensor, "T 3"]
) -> tuple[Float[Tensor, " M"], Float[Tensor, "M K"]]:
    """Of uncorrelated sums of second differences: the variance that noise of one metre gives them,
    and their mean squares."""
    noise, squares = [places.new_zeros(0)], [places.new_zeros(0, places.shape[1])]
    whole = known.unfold(0, 3, 1).all(-1)
    for start in range(0, len(factors), AT_ONCE):
        rows = whole[start : start + AT_ONCE].nonzero()[:, 0]
        window = slice(start, start + AT_ONCE + 2)
        onto = places.new_zeros(len(rows), len(places[window]))
        for k in range(3):
            onto[torch.arange(len(rows)), rows + k] = factors[start + rows, k]
        values, vectors = torch.linalg.eigh(onto @ onto.mT)
        sums = vectors.mT @ onto @ places[window].nan_to_num().flatten(1)
        noise.append(values.clamp_min(0))
        squares.append(sums.square().unflatten(1, places.shape[1:]).mean(-1))
    return torch.cat(noise), torch.cat(squares)


def _most_probable(
    noise: Float[Tensor, " M"], squares: Float[Tensor, " M"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Standard deviations of accelerations and of noise."""
    spread = RATIOS[:, None].square() + noise
    variance = (squares / spread).mean(-1)  # of the noise, at each ratio
    best = (variance.log() + spread.log().mean(-1)).argmin()
    deviation = variance[best].sqrt()
    return RATIOS[best] * deviation, deviation


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


# How far joints bend: soft limits on axis-angle components, from the T-pose, y up, facing +z.


# body joint (1..21) -> limits of the x, y, z components, degrees. Knees bend about +x, the left
# elbow about -y and the right one about +y; generous values of ordinary anatomy. A forearm that
# twists while the elbow is bent has a z component there, and a y component at the wrist.
LIMITS: dict[int, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    1: ((-120, 50), (-50, 50), (-30, 60)),
    2: ((-120, 50), (-50, 50), (-60, 30)),
    3: ((-25, 40), (-25, 25), (-20, 20)),
    4: ((-2, 150), (-10, 10), (-8, 8)),
    5: ((-2, 150), (-10, 10), (-8, 8)),
    6: ((-20, 30), (-25, 25), (-20, 20)),
    7: ((-40, 50), (-25, 25), (-20, 20)),
    8: ((-40, 50), (-25, 25), (-20, 20)),
    9: ((-15, 25), (-20, 20), (-15, 15)),
    10: ((-10, 30), (-3, 3), (-3, 3)),
    11: ((-10, 30), (-3, 3), (-3, 3)),
    12: ((-35, 40), (-45, 45), (-25, 25)),
    13: ((-10, 10), (-25, 15), (-15, 30)),
    14: ((-10, 10), (-15, 25), (-30, 15)),
    15: ((-30, 30), (-40, 40), (-20, 20)),
    16: ((-90, 90), (-130, 60), (-110, 100)),
    17: ((-90, 90), (-60, 130), (-100, 110)),
    18: ((-80, 80), (-150, 2), (-30, 30)),
    19: ((-80, 80), (-2, 150), (-30, 30)),
    20: ((-40, 40), (-45, 45), (-70, 70)),
    21: ((-40, 40), (-45, 45), (-70, 70)),
}


@functools.cache
def _bounds() -> tuple[Float[Tensor, "21 3"], Float[Tensor, "21 3"]]:
    """Lowest and highest angles, radians."""
    degrees = torch.tensor([LIMITS[joint] for joint in range(1, 22)])
    radians = degrees * (math.pi / 180)
    return radians[..., 0], radians[..., 1]


def beyond(body: Float[Tensor, "*batch 21 3"]) -> Float[Tensor, "*batch 21 3"]:
    """Radians by which angles exceed their limits, negative below the lowest; 0 within."""
    low, high = (bound.to(body) for bound in _bounds())
    return (body - high).clamp_min(0) - (low - body).clamp_min(0)


# How much residuals count.

OUTLIER = 3.0  # standard deviations at which a residual begins to count as an outlier


def robust_weights(
    squares: Float[Tensor, "*batch"], widen: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Cost and weight of squared residuals in standard deviations (Geman and McClure 1987).

    Args:
        widen: factor of the distance at which an outlier begins.
    """
    spread = (OUTLIER * widen) ** 2
    return spread * squares / (squares + spread), (spread / (squares + spread)).square()


# What is known of a body's pose before it is seen: how it rests and how far it turns.


# joint -> standard deviation from rest, radians; of the others FREE
SPREADS = {
    3: 0.25, 6: 0.2, 9: 0.2, 12: 0.3, 15: 0.3, 13: 0.2, 14: 0.2, 7: 0.35, 8: 0.35,
    10: 0.1, 11: 0.1, 20: 0.6, 21: 0.6,
}  # fmt: skip
FREE = 1.2
FOUND = 0.3  # radians that a pose by another program is off, of every joint
LIMIT = 0.1  # radians beyond a joint's limit that are as rare as one standard deviation
REST_LASTS = (
    0.3  # seconds: frames nearer than this are no evidence of their own of how a body rests
)


class PosePrior:
    """Departures of the 21 body joints from rest and beyond their limits.

    Args:
        turns: axis-angle of the joints as another program has found them, in place of rest.
    """

    def __init__(self, turns: Float[Tensor, "F 21 3"] | None = None) -> None:
        self.rest = (relaxed() if turns is None else turns).double().flatten(-2)
        spread = torch.full((21, 3), FREE, dtype=torch.float64)
        for joint, angle in SPREADS.items():
            spread[joint - 1] = angle
        if turns is not None:
            spread[:] = FOUND
        self.precision = spread.flatten().pow(-2)

    def add(
        self,
        body: Float[Tensor, "F 63"],
        share: Float[Tensor, " F"],
        equations: NormalEquations | None,
    ) -> Float[Tensor, ""]:
        """Cost, twice the negative logarithm of the density; adds to the equations, if any."""
        excess = beyond(body.unflatten(-1, (21, 3))).flatten(1)
        off = body - self.rest
        weight = self.precision * share[:, None]
        if equations is not None:
            equations.by_frame[:, 6:] += weight * off + excess / LIMIT**2
            equations.blocks[0].diagonal(dim1=1, dim2=2)[:, 6:] += weight + (excess != 0) / LIMIT**2
        return (weight * off.square()).sum() + (excess / LIMIT).square().sum()
