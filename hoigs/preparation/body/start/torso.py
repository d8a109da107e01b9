"""Where the body fit begins: orientation and place of the torso by closed forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import kabsch, matrices_to_quats
from hoigs.core.values.camera import Camera
from hoigs.preparation.body.landmarks import JOINTS, TORSO, LandmarkTrack
from hoigs.preparation.body.start.flat import flat_start, relaxed
from hoigs.preparation.body.start.limbs import limb_pose
from hoigs.preparation.body.start.placing import place

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
    body: BodyModel, landmarks: LandmarkTrack, cameras: Sequence[Camera], find_scale: bool
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
