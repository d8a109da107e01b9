"""Fitting a body to masks: its points lie on them, and near every pixel of them lies a point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.skinning import skin
from hoigs.core.values.moment import BodyPose

Project = Callable[[Float[Tensor, "F V 3"]], Float[Tensor, "F V 2"]]

POINTS = 400  # of the body's surface
PIXELS = 300  # of each mask
WIDTH = 160  # of the distance maps
COVER = 0.3  # weight of (b): a mask that also shows what is held cannot be covered
EVERY = 10  # energies between choices of the nearest points


class MaskFit:
    """Two distances between a body and what moves in the image, as parts of the image's width.

    `energy` is the mean over frames of a robust mean of (a) the distance of each of the body's
    points in the image from the mask and (b) the distance of each of the mask's pixels from the
    nearest point of the body, times `COVER`. The mask may also show what is held: what lies farther
    off than `spread` hardly counts. This is what places limbs in frames without landmarks.

    Args:
        masks: by frame, the person with or without what they hold; an empty one has no effect, and
            neither has a frame without one.
        spread: distance at which a point begins to count as an outlier, in image widths.
    """

    def __init__(
        self,
        body: BodyModel,
        masks: Sequence[Bool[np.ndarray, "H W"]],
        spread: float,
        seed: int = 0,
    ) -> None:
        self.body, self.spread = body, spread
        generator = torch.Generator().manual_seed(seed)
        count = len(body.skinning_weights)
        self.vertices = torch.randperm(count, generator=generator)[:POINTS]
        self.weights = body.skinning_weights[self.vertices]
        self.frames = torch.tensor(list(masks))
        stack = list(masks.values())
        height, self.width = stack[0].shape
        self.size = torch.tensor([self.width, height], dtype=torch.float32)
        self.shown = torch.tensor([bool(mask.any()) for mask in stack])
        self.outside = torch.stack([_distances(mask) for mask in stack])[:, None]
        self.pixels = torch.stack([_sample(mask, generator) for mask in stack])
        self._nearest: Tensor | None = None
        self._age = 0

    def energy(self, pose: BodyPose, project: Project, widen: float) -> Float[Tensor, ""]:
        """Both distances, in units of `spread` squared.

        Args:
            project: pixels of points of the world. widen: multiplies `spread`.
        """
        vertices, _ = self.body.shaped(pose.betas)
        transforms = self.body.skinning_transforms(pose)
        xy = project(skin(vertices[self.vertices], transforms, self.weights))[self.frames]
        off, inside = self._off_the_mask(xy)
        spread = (self.spread * widen) ** 2
        from_mask = _robust(off.square(), spread).sum(1) / inside.sum(1).clamp_min(1)
        if self._nearest is None or self._age >= EVERY:
            self._nearest, self._age = self._choose(xy.detach(), inside), 0
        self._age += 1
        near = xy.gather(1, self._nearest[..., None].expand(-1, -1, 2))
        bare = (near - self.pixels).square().sum(-1) / self.width**2
        return (
            (from_mask + COVER * _robust(bare, spread).mean(1)) * self.shown
        ).mean() / self.spread**2

    def _off_the_mask(self, xy: Float[Tensor, "F V 2"]) -> tuple[Tensor, Tensor]:
        """Distance of points from the mask, in widths, 0 beyond the image; and which are in it."""
        grid = 2 * xy / self.size - 1
        inside = (grid.detach().abs() <= 1).all(-1)
        sampled = torch.nn.functional.grid_sample(
            self.outside, grid[:, None], padding_mode="border", align_corners=False
        )
        return sampled[:, 0, 0] * inside, inside

    def _choose(self, xy: Tensor, inside: Tensor) -> Tensor:
        """The nearest point in the image for every pixel."""
        far = torch.cdist(self.pixels, xy)
        return far.masked_fill(~inside[:, None], torch.inf).argmin(-1)


def _robust(squared: Tensor, spread: float) -> Tensor:
    return spread * squared / (squared + spread)  # Geman-McClure


def _distances(mask: Bool[np.ndarray, "H W"]) -> Float[Tensor, "h w"]:
    """Distance to the mask, in widths, on a smaller grid; 0 everywhere of an empty one."""
    height, width = mask.shape
    if not mask.any():
        return torch.zeros(round(height * WIDTH / width), WIDTH)
    far = torch.from_numpy(ndimage.distance_transform_edt(~mask)).float() / width
    size = (round(height * WIDTH / width), WIDTH)
    return torch.nn.functional.interpolate(far[None, None], size, mode="area")[0, 0]


def _sample(mask: Bool[np.ndarray, "H W"], generator: torch.Generator) -> Float[Tensor, "P 2"]:
    """Pixel centres of a mask, some twice where it has few."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return torch.zeros(PIXELS, 2)
    chosen = torch.randint(len(rows), (PIXELS,), generator=generator).numpy()
    return torch.from_numpy(np.stack((columns[chosen], rows[chosen]), -1)).float() + 0.5
