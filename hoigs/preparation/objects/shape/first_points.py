"""Points that an object starts from: a sphere, or its outline inflated; colours from the frames."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.core.values.camera import Camera, pinhole_rays


def sphere_points(count: int, radius: float) -> Float[Tensor, "P 3"]:
    """Evenly spread points on a sphere (Fibonacci lattice), metres."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    turn = i * torch.pi * (3 - 5**0.5)
    ring = (1 - z * z).sqrt()
    return (radius * torch.stack((ring * turn.cos(), ring * turn.sin(), z), -1)).float()


class ColorSampler:
    """Median colours of moving points, over the frames in which they face the camera.

    A point counts in a frame if it faces the camera and lies on the object's mask. Points never
    seen take the colour of the nearest seen one.

    Args:
        points: canonical, about the object's centre. normals: unit, outwards.
    """

    def __init__(self, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> None:
        self.points, self.normals = points, normals
        self._samples: list[np.ndarray] = []

    def add(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        mask: Bool[np.ndarray, "H W"],
        camera: Camera,
        rotation: Float[Tensor, "3 3"],
        translation: Float[Tensor, " 3"],
    ) -> None:
        world = self.points @ rotation.mT + translation
        to_camera = torch.nn.functional.normalize(camera.center - world, dim=-1)
        facing = ((self.normals @ rotation.mT) * to_camera).sum(-1) > 0.3
        xy, depth = camera.project(world)
        seen = np.flatnonzero((camera.shows(xy, depth) & facing).numpy())
        column, row = xy[seen].long().numpy().T
        on_mask = mask[row, column]
        colors = np.full((len(world), 3), np.nan, np.float32)
        colors[seen[on_mask]] = image[row, column][on_mask] / np.float32(255)
        self._samples.append(colors)

    def colors(self) -> Float[Tensor, "P 3"]:
        """RGB in [0, 1]; mid-grey if no point was ever seen."""
        if not self._samples:
            return torch.full_like(self.points, 0.5)
        samples = np.stack(self._samples)
        seen = np.isfinite(samples[..., 0]).any(0)
        if not seen.any():
            return torch.full_like(self.points, 0.5)
        result = np.zeros(samples.shape[1:], np.float32)
        result[seen] = np.nanmedian(samples[:, seen], axis=0)
        known = torch.from_numpy(np.flatnonzero(seen))
        nearest = torch.cdist(self.points, self.points[known]).argmin(-1).numpy()
        result[~seen] = result[seen][nearest[~seen]]
        return torch.from_numpy(result)


def inflated_outline(
    mask: Bool[np.ndarray, "H W"], camera: Camera, depth: float, count: int
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """A front and a back sheet that meet at a mask's outline, and their outward normals.

    The half thickness at a pixel is sqrt(d (2 D - d)) / 2 for its distance d to the outline and
    the largest such distance D: a cushion, half as thick as it is wide. What the back looks like
    is not known.

    Args:
        depth: of the outline along z, metres.

    Returns:
        points in *camera* coordinates about their own mean direction, metres, and unit normals.
    """
    distance = ndimage.distance_transform_edt(mask)
    area = int(mask.sum())
    step = max(1, int(np.sqrt(area / max(1, count / 2))))
    rows, columns = np.nonzero(mask)
    keep = (rows % step == 0) & (columns % step == 0)
    rows, columns = rows[keep], columns[keep]
    scale = depth / float(camera.K[0, 0])
    inner = distance.max()
    relief = np.sqrt(np.clip(distance * (2 * inner - distance), 0, None)) / 2
    smooth_relief = ndimage.gaussian_filter(relief, 1.0)
    slope_y, slope_x = np.gradient(smooth_relief)
    half = relief[rows, columns] * scale
    pixels = torch.from_numpy(np.stack((columns + 0.5, rows + 0.5), -1))
    rays = pinhole_rays(camera.K.double(), pixels).numpy()
    sheets, normals = [], []
    for side in (-1.0, 1.0):
        z = depth + side * half
        sheets.append(np.concatenate((rays * z[:, None], z[:, None]), -1))
        tilt = np.stack((-slope_x[rows, columns], -slope_y[rows, columns]), -1)
        normals.append(np.concatenate((tilt, np.full((len(tilt), 1), side)), -1))
    points = torch.tensor(np.concatenate(sheets), dtype=torch.float32)
    outward = torch.tensor(np.concatenate(normals), dtype=torch.float32)
    return points, torch.nn.functional.normalize(outward, dim=-1)
