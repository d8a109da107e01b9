"""Where the body fit begins when landmarks are known in the image only: a relaxed, turned body."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.skinning import skin, transform_points
from hoigs.core.values.camera import pinhole_pixels
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.landmarks import points_of
from hoigs.preparation.body.start.placing import place

# arms are lowered, a little off the sides, elbows and knees are not stretched: joint -> axis-angle
RELAXED = {
    1: (-0.15, 0.0, 0.0), 2: (-0.15, 0.0, 0.0), 4: (0.3, 0.0, 0.0), 5: (0.3, 0.0, 0.0),
    16: (0.0, 0.0, -1.1), 17: (0.0, 0.0, 1.1), 18: (0.0, -0.4, 0.0), 19: (0.0, 0.4, 0.0),
}  # fmt: skip
ARMS = (13, 14, 15, 16, 17, 18, 19, 20, 21, 22)  # they hardly constrain where the torso faces
TURNS = 24  # directions tried, about the body's own upright axis
OUTLIER = 0.15  # of the person's extent in the image: a miss at which a landmark hardly counts
STEADY = 1.0  # price of a half turn from one frame to the next is twice this, in landmarks lost


def relaxed() -> Float[Tensor, "21 3"]:
    """Axis-angle of the body joints of someone who just stands there."""
    pose = torch.zeros(21, 3)
    for joint, angles in RELAXED.items():
        pose[joint - 1] = torch.tensor(angles)
    return pose


def flat_start(
    body: BodyModel, image: Float[Tensor, "S 33 3"], K: Float[Tensor, "S 3 3"]
) -> tuple[Float[Tensor, "S 3 3"], Float[Tensor, "S 33 3"]]:
    """Orientations of a relaxed body, and its landmarks about the hips along the cameras' axes.

    The image's up is taken for the body's, but for the torso's lean in it; which way it faces is
    tried out, and the cheapest steady course over the frames wins (Viterbi 1967).

    Args:
        image: x, y in pixels and visibility, NaN where not found.
    """
    model = _landmarks(body)
    angles = torch.arange(TURNS) * (2 * math.pi / TURNS)
    upright = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # y down, facing the camera
    lean = _about(2, _lean(image))[:, None]
    turns = lean @ upright @ _about(1, angles)  # [S, TURNS, 3, 3]
    world = torch.einsum("shij,lj->shli", turns, model)
    steady = image.clone()
    steady[:, list(ARMS)] = torch.nan
    costs = torch.stack([_miss(steady, world[:, h], K) for h in range(TURNS)], 1)
    chosen = _course(costs, STEADY * (1 - (angles[:, None] - angles).cos()))
    rows = torch.arange(len(image))
    return turns[rows, chosen], world[rows, chosen]


def _landmarks(body: BodyModel) -> Float[Tensor, "33 3"]:
    """The relaxed body's landmarks about the middle of its hips; NaN where it has none."""
    points = points_of(body)
    pose = BodyPose.zeros(1)
    pose = pose.replace(body=relaxed()[None], betas=torch.zeros(1, body.num_betas))
    vertices, joints = body.shaped(pose.betas[0])
    transforms = body.skinning_transforms(pose)[0]
    weights = body.skinning_weights[points.vertices]
    places = torch.cat(
        (
            transform_points(transforms[points.joints], joints[points.joints]),
            skin(vertices[points.vertices], transforms, weights),
        )
    )
    found = torch.full((33, 3), torch.nan)
    found[list(points.landmarks)] = places.detach()
    return found - found[[23, 24]].mean(0)


def _about(axis: int, angle: Float[Tensor, " N"]) -> Float[Tensor, "N 3 3"]:
    """Rotations about the y (1) or z (2) axis."""
    one, zero = torch.ones_like(angle), torch.zeros_like(angle)
    c, s = angle.cos(), angle.sin()
    rows = (c, zero, s, zero, one, zero, -s, zero, c) if axis == 1 else (
        c, -s, zero, s, c, zero, zero, zero, one)  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _lean(image: Float[Tensor, "S 33 3"]) -> Float[Tensor, " S"]:
    """Angle from the image's up to the torso, radians, clockwise; 0 where it is not seen."""
    up = image[:, [11, 12], :2].mean(1) - image[:, [23, 24], :2].mean(1)
    return torch.atan2(up[:, 0], -up[:, 1]).nan_to_num()


def _miss(
    image: Float[Tensor, "S 33 3"], world: Float[Tensor, "S 33 3"], K: Float[Tensor, "S 3 3"]
) -> Float[Tensor, " S"]:
    """Part of the visible landmarks that a body misses, robustly, 0..1, where it is best placed."""
    known = torch.isfinite(image).all(-1) & torch.isfinite(world).all(-1)
    points = (world + place(image, world, K)[:, None]).nan_to_num()
    pixels = pinhole_pixels(K[:, None], points, near=0.1)
    at = image[..., :2].nan_to_num()
    weight = torch.where(known, image[..., 2], 0.0)
    total = weight.sum(1).clamp_min(1e-6)
    center = (weight[..., None] * at).sum(1, keepdim=True) / total[:, None, None]
    extent = (weight * (at - center).square().sum(-1)).sum(1) / total
    squared = (pixels - at).square().sum(-1) / extent[:, None].clamp_min(1e-6)
    miss = squared / (squared + OUTLIER**2)
    miss = torch.where(points[..., 2] > 0.1, miss, 1.0)
    return (weight * miss).sum(1) / total


def _course(costs: Float[Tensor, "S H"], steps: Float[Tensor, "H H"]) -> Int[Tensor, " S"]:
    """Of the sequences of hypotheses, the one that costs least, steps between them included."""
    total, before = costs[0], []
    for row in costs[1:]:
        best = (total[:, None] + steps).min(0)
        before.append(best.indices)
        total = best.values + row
    chosen = [int(total.argmin())]
    for back in reversed(before):
        chosen.append(int(back[chosen[-1]]))
    return torch.tensor(chosen[::-1])
