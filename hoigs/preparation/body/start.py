"""Where the body fit begins: torso by closed forms, limbs, and landmarks in the image alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import kabsch, matrices_to_axis_angle, matrices_to_quats
from hoigs.core.maths.skinning import skin, transform_points
from hoigs.core.values.camera import Camera, pinhole_pixels, pinhole_rays
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.landmarks import JOINTS, TORSO, Landmarks, points_of

# Limbs at the start of the body fit: hips, knees, shoulders and elbows from 3D landmarks.


# joints (root, hinge), landmarks (root, middle, end), bone direction and hinge axis at rest.
# About its hinge a positive angle bends: knees backwards, elbows forwards.
LIMBS = (
    (16, 18, (11, 13, 15), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    (17, 19, (12, 14, 16), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    (1, 4, (23, 25, 27), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
    (2, 5, (24, 26, 28), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),
)
STRAIGHT = 0.3  # sine of the bend below which the limb's own plane is not to be trusted


def limb_pose(
    world: Float[Tensor, "S 33 3"], torso: Float[Tensor, "S 3 3"]
) -> Float[Tensor, "S 21 3"]:
    """Axis-angle of the body joints that turn each limb onto the landmarks; others are zero.

    Args:
        world: landmarks, any one frame of axes. torso: rotation from the rest pose to that frame.
    """
    pose = world.new_zeros(len(world), 21, 3)
    for root, hinge, marks, along, about in LIMBS:
        points = world[:, list(marks)] @ torso  # in the torso's axes: rows times R is R^T x
        upper, lower = (
            torch.nn.functional.normalize(points[:, k + 1] - points[:, k], dim=-1) for k in (0, 1)
        )
        rest, axis = world.new_tensor(along), world.new_tensor(about)
        # a straight limb has no plane: there the turn of the bone alone gives the hinge's axis
        plain = (_smallest_turn(rest, upper) @ axis[:, None])[..., 0]
        seen = torch.linalg.cross(upper, lower)
        turned = _frame(upper, seen + STRAIGHT * plain)
        turn = turned @ _frame(rest[None], axis[None]).mT
        bend = torch.atan2(
            (torch.linalg.cross(upper, lower) * turned[..., 1]).sum(-1), (upper * lower).sum(-1)
        )
        pose[:, root - 1] = matrices_to_axis_angle(turn)
        pose[:, hinge - 1] = bend.clamp_min(0)[:, None] * axis
    return pose


def _frame(along: Float[Tensor, "S 3"], about: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3 3"]:
    """Right-handed frames with columns `along`, `about` made orthogonal to it, and the third."""
    about = about - (about * along).sum(-1, keepdim=True) * along
    about = torch.nn.functional.normalize(about, dim=-1)
    return torch.stack((along, about, torch.linalg.cross(along, about)), -1)


def _smallest_turn(rest: Float[Tensor, "3"], upper: Float[Tensor, "S 3"]) -> Float[Tensor, "S 3 3"]:
    """Rotations by the smallest angle that take `rest` to each of `upper`."""
    from kornia.geometry.conversions import vector_to_skew_symmetric_matrix

    cross = vector_to_skew_symmetric_matrix(torch.linalg.cross(rest.expand_as(upper), upper))
    cosine = (upper @ rest)[:, None, None]
    return torch.eye(3).to(upper) + cross + cross @ cross / (1 + cosine).clamp_min(1e-3)


# Where a body is, from its landmarks in space and in the image.

REWEIGHTINGS = 5


def place(
    image: Float[Tensor, "N L 3"], world: Float[Tensor, "N L 3"], K: Float[Tensor, "N 3 3"]
) -> Float[Tensor, "N 3"]:
    """Positions of the landmarks' origin along the cameras' axes, from a robust linear fit.

    (X + tx) f = (x - c) (Z + tz), two equations a landmark, weighted by visibility and, again and
    again, by how well the landmark agrees with the others. Landmarks that are NaN in the image or
    in space do not count. In float64, by arithmetic that comes out the same wherever memory lies,
    which LAPACK's does not: the body fit multiplies a last digit.

    Args:
        image: x, y in pixels and visibility. world: metres, along the camera's axes.
    """
    known = torch.isfinite(image).all(-1) & torch.isfinite(world).all(-1)
    image, world, K = (torch.nan_to_num(x.double()) for x in (image, world, K))
    ray = pinhole_rays(K[:, None], image[..., :2])
    right = ray * world[..., 2:] - world[..., :2]
    visible = torch.where(known, image[..., 2], 0.0)
    weight, found = visible, world.new_zeros(len(world), 3)
    for _ in range(REWEIGHTINGS):
        found = _least_squares(ray, right, weight.square())
        miss = (found[:, None, :2] - ray * found[:, None, 2:] - right).norm(dim=-1)
        typical = torch.where(known, miss, torch.nan).nanmedian(1, keepdim=True).values
        weight = visible / (1 + (miss / (2 * typical.clamp_min(1e-3))).square())
    return found.float()


def _least_squares(
    ray: Float[Tensor, "N L 2"], right: Float[Tensor, "N L 2"], weight: Float[Tensor, "N L"]
) -> Float[Tensor, "N 3"]:
    """t that minimises the weighted squares of t_xy - ray t_z - right."""
    w = weight[..., None]
    total = weight.sum(1, keepdim=True)
    mean_ray, mean_right = (w * ray).sum(1) / total, (w * right).sum(1) / total
    # with t_xy = mean_ray t_z + mean_right put in, one unknown is left
    off_ray, off_right = ray - mean_ray[:, None], right - mean_right[:, None]
    across = (w * off_ray * off_right).sum((1, 2))
    z = -across / (w * off_ray.square()).sum((1, 2)).clamp_min(1e-12)
    return torch.cat((mean_ray * z[:, None] + mean_right, z[:, None]), -1)


# Where the body fit begins when landmarks are known in the image only: a relaxed, turned body.


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
    # the relaxed body's landmarks about the middle of its hips; NaN where it has none
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
    model = found - found[[23, 24]].mean(0)
    angles = torch.arange(TURNS) * (2 * math.pi / TURNS)
    upright = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # y down, facing the camera
    lean = _about(2, _lean(image))[:, None]
    turns = lean @ upright @ _about(1, angles)  # [S, TURNS, 3, 3]
    world = torch.einsum("shij,lj->shli", turns, model)
    steady = image.clone()
    steady[:, list(ARMS)] = torch.nan
    costs = torch.stack([_miss(steady, world[:, h], K) for h in range(TURNS)], 1)
    # of the sequences of hypotheses, the one that costs least, steps between them included
    steps = STEADY * (1 - (angles[:, None] - angles).cos())
    total, before = costs[0], []
    for row in costs[1:]:
        best = (total[:, None] + steps).min(0)
        before.append(best.indices)
        total = best.values + row
    path = [int(total.argmin())]
    for back in reversed(before):
        path.append(int(back[path[-1]]))
    chosen = torch.tensor(path[::-1])
    rows = torch.arange(len(image))
    return turns[rows, chosen], world[rows, chosen]


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


ANKLES = (27, 28)


@dataclass(frozen=True)
class Start:
    """First guesses for every frame; frames without landmarks are interpolated.

    Attributes:
        global_orient: axis-angle, continuous over frames. transl: metres, world.
        body: axis-angle of joints 1..21; limbs follow the 3D landmarks, or hang down without
            any; the spine is straight.
        scale: metres a unit of the cameras' world.
    """

    global_orient: Float[Tensor, "F 3"]
    transl: Float[Tensor, "F 3"]
    body: Float[Tensor, "F 21 3"]
    scale: float

    def part(self, frames: slice) -> Start:
        """Of some frames alone."""
        return replace(
            self,
            global_orient=self.global_orient[frames],
            transl=self.transl[frames],
            body=self.body[frames],
        )


def first_guess(
    body: BodyModel, landmarks: Landmarks, cameras: Sequence[Camera], find_scale: bool
) -> Start:
    """Torso by Kabsch, depth by a linear fit of the 3D landmarks to the 2D ones; where there are
    no 3D landmarks, by those of a relaxed body (`flat_start`).
    """
    seen, solid = landmarks.found, landmarks.solid[landmarks.found]
    _, joints = body.shaped(torch.zeros(body.num_betas))
    torso = joints[[JOINTS[mark] for mark in TORSO]]
    image, world = landmarks.image[seen], landmarks.world[seen].clone()
    K = torch.stack([c.K for c in cameras])[seen]
    rotations = torch.eye(3).repeat(len(world), 1, 1)
    limbs = torch.zeros(len(world), 21, 3)
    if solid.any():
        rotations[solid] = torch.stack([kabsch(torso, w[list(TORSO)]) for w in world[solid]])
        limbs[solid] = limb_pose(world[solid], rotations[solid])
    if not solid.all():
        rotations[~solid], world[~solid] = flat_start(body, image[~solid], K[~solid])
        limbs[~solid] = relaxed()
    middle = place(image, world, K)  # camera axes, metres
    turn = torch.stack([cameras[i].world_to_camera[:3, :3] for i in range(len(seen))])
    shift = torch.stack([cameras[i].world_to_camera[:3, 3] for i in range(len(seen))])
    back = turn[seen].mT
    scale = 1.0
    if find_scale:
        ankles = world[:, list(ANKLES)] + middle[:, None]
        centers = -(back @ shift[seen][..., None])[..., 0]
        scale = _still_feet((back[:, None] @ ankles[..., None])[..., 0], centers)
    where = (back @ (middle - scale * shift[seen])[..., None])[..., 0]
    orient = back @ rotations
    pelvis, between_hips = joints[0], joints[[1, 2]].mean(0)
    transl = where - (orient @ (between_hips - pelvis)[..., None])[..., 0] - pelvis
    return Start(
        _fill(_continuous_axis_angle(orient), seen),
        _fill(transl, seen),
        _fill(limbs.flatten(1), seen).unflatten(1, (21, 3)),
        scale,
    )


def _still_feet(ankles: Float[Tensor, "F 2 3"], centers: Float[Tensor, "F 3"]) -> float:
    """The scale under which ankles move least: robust least squares of steps against the camera's.

    Raises no error for a camera that does not move: then any scale serves, and it is 1.
    """
    steps = (ankles[1:] - ankles[:-1]).flatten(0, 1)
    camera = (centers[1:] - centers[:-1])[:, None].expand(-1, 2, 3).flatten(0, 1)
    if float(camera.norm(dim=-1).max()) < 1e-6:
        return 1.0
    weight = torch.ones(len(steps))
    scale = 1.0
    for _ in range(20):
        top = -(weight * (steps * camera).sum(-1)).sum()
        scale = float(top / (weight * camera.square().sum(-1)).sum())
        miss = (steps + scale * camera).norm(dim=-1)
        weight = 1 / (miss + miss.median().clamp_min(1e-4))
    return max(scale, 1e-3)


def _continuous_axis_angle(rotations: Float[Tensor, "F 3 3"]) -> Float[Tensor, "F 3"]:
    """Axis-angle vectors without jumps between frames: angles may exceed pi."""
    quats = matrices_to_quats(rotations)
    for i in range(1, len(quats)):
        if float((quats[i] * quats[i - 1]).sum()) < 0:
            quats[i] = -quats[i]
    sine = quats[:, 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, quats[:, :1])
    return quats[:, 1:] / sine.clamp_min(1e-8) * angle


def _fill(values: Float[Tensor, "S D"], seen: Bool[Tensor, " F"]) -> Float[Tensor, "F D"]:
    """Values of the seen frames, interpolated linearly over the others, held at the ends."""
    known = seen.nonzero().squeeze(1)
    frames = torch.arange(len(seen))
    right = torch.searchsorted(known, frames).clamp(max=len(known) - 1)
    left = (right - 1).clamp_min(0)
    left = torch.where(known[right] <= frames, right, left)
    span = (known[right] - known[left]).clamp_min(1)
    r = ((frames - known[left]).clamp(min=0) / span).clamp(max=1.0)[:, None]
    return values[left] * (1 - r) + values[right] * r
