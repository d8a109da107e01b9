"""Where a body is, from its landmarks in space and in the image."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.camera import pinhole_rays

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
