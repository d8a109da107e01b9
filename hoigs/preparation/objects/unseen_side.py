"""The side of an object that no frame shows: as far as outlines allow, and of a supposed depth."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.objects.alignment import FACING, Poses, Surface
from hoigs.preparation.objects.crops import Crops
from hoigs.preparation.objects.surface import reaches

ONE_SIDED = 0.9  # mean of the unit directions to the cameras: from there on they see one side
SEEN = 0.2  # of the frames in which a vertex faces the camera: what they show stays as it is
DEPTH = 0.85  # of the root of its outlines' area: midway between what a search tries
WHOLE = 0.75  # quantile of the areas: hands hide a part of it in some frames
CARVED = 0.02  # of the frames may show background at the new surface; poses are good by now


def completed(
    crops: Crops, surface: Surface, poses: Poses, vertices: Float[Tensor, "V 3"], radius: float
) -> tuple[Float[Tensor, "V 3"], float | None]:
    """Vertices with the unseen side filled, and the depth that it was filled to, metres; as they
    are, and None, where the frames show more than one side.

    The alignment leaves what no frame shows as small and smooth as outlines allow, a dome behind
    the front. Most things are about as deep as they are broad and high: each unseen vertex goes
    along its ray from the middle as far as the masks of (nearly) all frames allow, within a slab of
    that depth across the mean view.

    Args:
        radius: metres within which the object lies.
    """
    middle = (vertices.amax(0) + vertices.amin(0)) / 2
    placed = Poses(poses.rotations, poses.translations + poses.rotations @ middle)
    toward = ((crops.centers() - placed.translations)[:, None] @ placed.rotations)[:, 0]
    toward = torch.nn.functional.normalize(toward, dim=-1)
    view = toward.mean(0)
    if view.norm() < ONE_SIDED:
        return vertices, None
    view = torch.nn.functional.normalize(view, dim=0)
    away = (crops.centers() - placed.translations).norm(dim=-1)
    areas = crops.masks.sum((1, 2, 3)) * (away / crops.K[:, 0, 0]).square()
    depth = DEPTH * float(areas.quantile(WHOLE)) ** 0.5
    rays = torch.nn.functional.normalize(vertices - middle, dim=-1)
    slab = depth / 2 / (rays @ view).abs().clamp_min(1e-6)
    filled = rays * torch.minimum(reaches(crops, placed, rays, radius, CARVED), slab)[:, None]
    facing = surface.vertex_normals(vertices) @ toward.mT > FACING
    unseen = facing.float().mean(1) < SEEN
    return torch.where(unseen[:, None], filled + middle, vertices), depth
