"""Fitting a body to masks: its points lie on them, and near every pixel of them lies a point."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image, ImageDraw
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.kinematics import Kinematics, NormalEquations, Posed

# of points in the world and the frames they are in: pixels, and their derivatives by the points
Project = Callable[
    [Float[Tensor, "F V 3"], Int[Tensor, " F"]],
    tuple[Float[Tensor, "F V 2"], Float[Tensor, "F V 2 3"]],
]


class Masks(Protocol):
    """One mask a frame, read on access."""

    def __getitem__(self, frame: int, /) -> Bool[np.ndarray, "H W"]: ...


POINTS = 400  # of the body's surface
PIXELS = 300  # of each mask
WIDTH = 160  # of the distance maps
SIGMA = 0.006  # how far a mask's edge is off, in widths
CHUNK = 16  # frames at a time
COVER = 0.3  # weight of (b): a mask that also shows what is held cannot be covered


class MaskFit:
    """Two distances between a body and what moves in the image, as parts of the image's width.

    `energy` is, of each frame, a robust mean of (a) the squared distance of each of the body's
    points in the image from the mask and (b) the squared distance of each of the mask's pixels
    from the nearest point of the body, times `COVER`. The mask may also show what is held: what
    lies farther off than `spread` hardly counts. This is what places limbs in frames without
    landmarks.

    Args:
        masks: by frame, the person with or without what they hold; an empty one has no effect, and
            neither has a frame without one.
        spread: distance at which a point begins to count as an outlier, in image widths.
        weight: of the means.
    """

    def __init__(
        self,
        body: BodyModel,
        masks: Mapping[int, Bool[np.ndarray, "H W"]],
        spread: float,
        weight: float = 1.0,
        seed: int = 0,
    ) -> None:
        self.spread, self.weight = spread, weight
        generator = torch.Generator().manual_seed(seed)
        count = len(body.skinning_weights)
        vertices = torch.randperm(count, generator=generator)[:POINTS]
        self.kinematics = Kinematics(body, vertices[:0], vertices)
        self.frames = torch.tensor(list(masks))
        stack = list(masks.values())
        height, self.width = stack[0].shape
        self.size = torch.tensor([self.width, height], dtype=torch.float32)
        self.shown = torch.tensor([bool(mask.any()) for mask in stack])
        self.outside = torch.stack([_distances(mask) for mask in stack])[:, None]
        self.pixels = torch.stack([_sample(mask, generator) for mask in stack]).double()
        self._nearest: Tensor | None = None  # chosen anew with every step, kept while it is tried

    def energy(
        self,
        pose: BodyPose,
        project: Project,
        widen: float,
        equations: NormalEquations | None = None,
    ) -> float:
        """Both distances, in units of `SIGMA` squared; adds to the equations, if any.

        Args:
            project: see `Project`. widen: multiplies `spread`.
        """
        if equations is not None:
            self._nearest = None
        nearest = [] if self._nearest is None else list(self._nearest.split(CHUNK))
        total = 0.0
        for k, rows in enumerate(torch.arange(len(self.frames)).split(CHUNK)):
            frames = self.frames[rows]
            at = self.kinematics.posed(
                _rows(pose, frames),
                torch.zeros(POINTS, 3, dtype=torch.float64),
                derivatives=equations is not None,
            )
            xy, by_point = project(at.points, frames)
            if self._nearest is None:
                nearest.append(self._choose(xy, self._inside(xy), rows))
            total += self._of(rows, at, xy, by_point, nearest[k], widen, equations)
        self._nearest = torch.cat(nearest)
        return total

    def _of(
        self, rows: Tensor, at: Posed, xy: Tensor, by_point: Tensor, nearest: Tensor,
        widen: float, equations: NormalEquations | None,
    ) -> float:  # fmt: skip
        spread = (self.spread * widen / SIGMA) ** 2
        unit = SIGMA * self.width
        off, slope, inside = self._off_the_mask(xy, rows)
        off, slope = off / SIGMA, slope / SIGMA
        shown = self.weight * self.shown[rows, None]
        each = shown * inside / inside.sum(1, keepdim=True).clamp_min(1)
        gap = (xy.gather(1, nearest[..., None].expand(-1, -1, 2)) - self.pixels[rows]) / unit
        squares = gap.square().sum(-1)
        share = shown * COVER / PIXELS
        total = (each * _robust(off.square(), spread)).sum() + (
            share * _robust(squares, spread)
        ).sum()
        if equations is not None:
            # all pixels that pull at a point pull at it together
            pull = share * (spread / (squares + spread)).square()
            weight = torch.zeros_like(off).scatter_add(1, nearest, pull)
            toward = torch.zeros_like(xy).scatter_add(
                1, nearest[..., None].expand(-1, -1, 2), pull[..., None] * gap
            )
            toward = toward / weight.clamp_min(1e-12)[..., None]
            across = torch.cat(
                (slope[..., None, :], torch.eye(2).to(xy).expand(*off.shape, 2, 2) / unit), -2
            )
            residuals = torch.cat((off[..., None], toward), -1)
            out = each * (spread / (off.square() + spread)).square()
            weights = torch.stack((out, weight, weight), -1)
            by_point = across @ by_point
            part = NormalEquations(len(rows), equations.by_frame.shape[1], len(equations.by_shared))
            shared = torch.nn.functional.pad(
                by_point @ at.by_betas, (0, len(equations.by_shared) - at.by_betas.shape[-1])
            )
            part.add(
                residuals.flatten(1), weights.flatten(1),
                (by_point @ at.by_frame).flatten(1, 2), shared.flatten(1, 2),
            )  # fmt: skip
            equations.take(part, self.frames[rows])
        return float(total)

    def _inside(self, xy: Float[Tensor, "F V 2"]) -> Bool[Tensor, "F V"]:
        return ((2 * xy / self.size - 1).abs() <= 1).all(-1)

    def _off_the_mask(
        self, xy: Float[Tensor, "F V 2"], rows: Int[Tensor, " F"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Distance of points from the mask, in widths, 0 beyond the image; its derivative by
        pixels; and which are in the image."""
        inside = self._inside(xy)
        with torch.enable_grad():
            at = xy.detach().float().requires_grad_()
            sampled = torch.nn.functional.grid_sample(
                self.outside[rows], (2 * at / self.size - 1)[:, None],
                padding_mode="border", align_corners=False,
            )[:, 0, 0] * inside  # fmt: skip
            (slope,) = torch.autograd.grad(sampled.sum(), at)
        return sampled.detach().double(), slope.double(), inside

    def _choose(self, xy: Tensor, inside: Tensor, rows: Tensor) -> Tensor:
        """The nearest point in the image for every pixel."""
        far = torch.cdist(self.pixels[rows], xy)
        return far.masked_fill(~inside[:, None], torch.inf).argmin(-1)


def _rows(pose: BodyPose, frames: Int[Tensor, " F"]) -> BodyPose:
    return pose.replace(
        global_orient=pose.global_orient[frames],
        body=pose.body[frames],
        left_hand=pose.left_hand[frames],
        right_hand=pose.right_hand[frames],
        transl=pose.transl[frames],
    )


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


# The outline of a posed body in an image.

NEAR = 0.05  # metres; triangles nearer than this are left out


def silhouette(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "T 3"], camera: Camera
) -> Bool[np.ndarray, "H W"]:
    """Pixels that a mesh covers. Only triangles that face the camera are drawn: on a closed mesh
    they cover all.
    """
    xy, depth = camera.project(vertices)
    corners = xy[faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # y points down: a triangle that is counter-clockwise from outside has negative area here
    facing = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) < 0
    ahead = (depth[faces] > NEAR).all(-1)
    image = Image.new("L", (camera.width, camera.height))
    draw = ImageDraw.Draw(image)
    # PIL's integer coordinates are pixel centres
    for triangle in (corners[facing & ahead] - 0.5).reshape(-1, 6).tolist():
        draw.polygon(triangle, fill=255)
    return np.asarray(image) > 0


@torch.no_grad()
def posed(
    body: BodyModel, poses: BodyPose, chunk: int = 32
) -> Iterator[tuple[Float[Tensor, "V 3"], Float[Tensor, "J 3"]]]:
    """Vertices and joints frame by frame, world, metres; a few frames are posed at a time."""
    count = len(poses.transl)
    for start in range(0, count, chunk):
        part = slice(start, min(start + chunk, count))
        some = poses.replace(
            global_orient=poses.global_orient[part],
            body=poses.body[part],
            left_hand=poses.left_hand[part],
            right_hand=poses.right_hand[part],
            transl=poses.transl[part],
        )
        out = body(some)
        yield from zip(out.vertices, out.joints, strict=True)
