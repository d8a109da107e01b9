"""The side of an object that no frame shows: like the opposite side, within the outlines."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.objects.alignment import FACING, Poses, Surface
from hoigs.preparation.objects.crops import Crops
from hoigs.preparation.objects.shape.surface import reaches

ONE_SIDED = 0.9  # mean of the unit directions to the cameras: from there on they see one side
SEEN = 0.2  # of the frames in which a vertex faces the camera: what they show stays as it is
DEPTH = 0.85  # of the root of its outlines' area: midway between what a search tries
WHOLE = 0.75  # quantile of the areas: hands hide a part of it in some frames
FRONT = 0.9  # quantile of what is seen, along the view: the outermost may be a bulge
OPPOSITE = 0.15  # radians within which a seen vertex lies opposite an unseen one
DIRECTIONS = 64  # across the view, in which the middle is measured
CARVED = 0.02  # of the frames may show background at the new surface; poses are good by now


def completed(
    crops: Crops, surface: Surface, poses: Poses, vertices: Float[Tensor, "V 3"], radius: float
) -> tuple[Float[Tensor, "V 3"], float | None]:
    """Vertices with the unseen side filled, and the depth that it was filled to, metres; as they
    are, and None, where the frames show more than one side.

    The alignment leaves what no frame shows as small and smooth as outlines allow: a dome behind
    the front, which also hangs down behind a thing seen from above. Most things are about as deep
    as they are broad and high, and about the same on opposite sides: each unseen vertex goes along
    its ray from the middle as far as the seen vertex opposite, or where there is none as a slab of
    that depth across the mean view, but no farther than the masks of (nearly) all frames allow.

    Args:
        radius: metres within which the object lies.
    """
    middle = (vertices.amax(0) + vertices.amin(0)) / 2
    toward = (crops.centers() - poses.translations - poses.rotations @ middle)[:, None]
    toward = (toward @ poses.rotations)[:, 0]
    away, toward = toward.norm(dim=-1), torch.nn.functional.normalize(toward, dim=-1)
    view = toward.mean(0)
    if view.norm() < ONE_SIDED:
        return vertices, None
    view = torch.nn.functional.normalize(view, dim=0)
    areas = crops.masks.sum((1, 2, 3)) * (away / crops.K[:, 0, 0]).square()
    depth = DEPTH * float(areas.quantile(WHOLE)) ** 0.5
    facing = surface.vertex_normals(vertices) @ toward.mT > FACING
    seen = facing.float().mean(1) >= SEEN
    front = float((vertices[seen] @ view).quantile(FRONT))
    middle = _across(vertices, view) + view * (front - depth / 2)
    placed = Poses(poses.rotations, poses.translations + poses.rotations @ middle)
    rays = torch.nn.functional.normalize(vertices - middle, dim=-1)
    slab = depth / 2 / (rays @ view).abs().clamp_min(1e-6)
    cosine, nearest = (-rays @ rays[seen].mT).max(1)
    opposite = (vertices[seen] - middle).norm(dim=-1)[nearest]
    wanted = torch.where(cosine > math.cos(OPPOSITE), opposite, slab)
    reach = torch.minimum(reaches(crops, placed, rays, radius, CARVED), wanted)
    return torch.where(seen[:, None], vertices, middle + rays * reach[:, None]), depth


def _across(vertices: Float[Tensor, "V 3"], view: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The middle across the view, nearest to the middles of the extents in many directions: that
    of a thing that is alike on opposite sides shows in its outline."""
    angles = torch.arange(DIRECTIONS) * torch.pi / DIRECTIONS
    plane = torch.linalg.svd(view[None]).Vh[1:]  # two directions across the view
    directions = torch.stack((angles.cos(), angles.sin()), -1) @ plane
    along = vertices @ directions.mT
    middles = (along.amax(0) + along.amin(0)) / 2
    return torch.linalg.lstsq(directions @ plane.mT, middles[:, None]).solution[:, 0] @ plane
