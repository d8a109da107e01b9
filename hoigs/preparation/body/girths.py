"""A body's girths by the outlines of its masks, which landmarks do not show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import PART_NAMES, BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.kinematics import Kinematics
from hoigs.preparation.body.mask_fit import posed, silhouette
from hoigs.preparation.body.priors import robust_weights

NEAR = 0.1  # metres
POINTS = 80  # of the outline in a frame, at most
WIDTH = 320  # pixels of the images in which outlines are compared
ROUNDS = 4  # points of the outline are chosen anew in each
# hair, flat hands and shoes are no measure of the body
LEFT_OUT = [
    PART_NAMES.index(name)
    for name in ("head", "left hand", "right hand", "left foot", "right foot")
]
SIDEWAYS = 0.3  # cosine between normal and ray, of what may be the outline
REACH, STEPS = 0.08, 33  # metres along a normal in which the mask's edge is looked for, and samples
INSIDE = 2.5  # pixels from the outline, where the body is shown and is not
CLEAR = 0.05  # metres beyond the outline that show nothing of the body
SMOOTH = 1.5  # pixels, of the mask's normals
ALIKE = 0.7  # cosine between the normals of body and mask
# metres that clothes and pose take an outline off, and pixels that the mask's edge is off
SIGMA, EDGE = 0.015, 1.0
INDEPENDENT = 40.0  # points that all are worth: clothes are off alike in all frames
SHAPE = 1.0  # standard deviation of adults' shape coefficients
HELD = 0.01  # metres that joints may be off from where landmarks have placed them


@dataclass(frozen=True)
class Gaps:
    """How far the mask's edge lies outside of points of the body's outline, in one frame.

    Attributes:
        vertices: of the body. normals: theirs, world.
        metres: along them, negative inside. spreads: standard deviations of these.
    """

    vertices: Int[Tensor, " R"]
    normals: Float[Tensor, "R 3"]
    metres: Float[Tensor, " R"]
    spreads: Float[Tensor, " R"]


def girths(
    body: BodyModel,
    pose: BodyPose,
    cameras: Sequence[Camera],
    masks: Mapping[int, Bool[np.ndarray, "H W"]],
) -> Float[Tensor, " B"]:
    """Shape coefficients of a posed body whose outlines are those of its masks.

    Gauss and Newton on the coefficients alone, with poses as they are. Where the mask has no edge
    near the outline and along it, as behind a table, nothing is compared; what is off by far
    hardly counts.

    Args:
        pose: batched over the frames of the clip. cameras: of these, in metres.
        masks: of some of the frames; one may be empty.
    """
    small = {frame: _small(mask) for frame, mask in masks.items()}
    views = [cameras[i].resized(mask.shape[1], mask.shape[0]) for i, mask in small.items()]
    some = pose.frame(torch.tensor(list(small)))
    generator = torch.Generator().manual_seed(0)
    none = torch.zeros(0, dtype=torch.long)
    moves = Kinematics(body, none, none).joints_by_betas
    moves = (moves - moves[:, :1]).flatten(1).T / HELD  # of the joints about the root
    betas = pose.betas.double()
    for _ in range(ROUNDS):
        some = some.replace(betas=betas)
        surfaces = posed(body, some.map(lambda x: x.float()))
        gaps, slopes = [], []
        for k, ((vertices, _), view, mask) in enumerate(
            zip(surfaces, views, small.values(), strict=True)
        ):
            found = outline_gaps(body, vertices, view, mask, generator)
            still = torch.zeros(len(found.vertices), 3, dtype=torch.float64)
            at = Kinematics(body, none, found.vertices).posed(some.frame(slice(k, k + 1)), still)
            outward = torch.einsum("rc,rcb->rb", found.normals, at.by_betas[0])
            slopes.append(outward / found.spreads[:, None])
            gaps.append(found.metres / found.spreads)
        by_betas, gap = torch.cat(slopes), torch.cat(gaps)
        _, weight = robust_weights(gap.square(), 1.0)
        weight = weight * min(1.0, INDEPENDENT / max(1, len(gap)))
        moved = moves.mT @ (moves @ (betas - pose.betas))
        left = by_betas.mT @ (weight[:, None] * by_betas) + moves.mT @ moves
        left += torch.eye(len(betas)) / SHAPE**2
        betas = betas + torch.linalg.solve(
            left, by_betas.mT @ (weight * gap) - betas / SHAPE**2 - moved
        )
    return betas


def outline_gaps(
    body: BodyModel,
    vertices: Float[Tensor, "V 3"],
    camera: Camera,
    mask: Float[np.ndarray, "H W"],
    generator: torch.Generator,
) -> Gaps:
    """Of points on a posed body's outline by which the mask has an edge.

    Args:
        vertices: world, metres. mask: 0..1, of the camera's size.
    """
    drawn = silhouette(vertices, body.faces, camera).astype(np.float32)
    normals = _normals(vertices, body.faces)
    xy, depth = camera.project(vertices)
    shown = camera.shows(xy, depth, near=NEAR)
    cam, turned = camera.to_camera(vertices), normals @ camera.world_to_camera[:3, :3].T
    facing = (torch.nn.functional.normalize(cam, dim=-1) * turned).sum(-1)
    depth = depth.clamp_min(NEAR)[:, None]
    across = turned[:, :2] - cam[:, :2] / depth * turned[:, 2:]
    across = torch.nn.functional.normalize(across, dim=-1)
    metre = camera.K[0, 0] / depth  # in pixels
    left_out = torch.isin(body.vertex_parts, torch.tensor(LEFT_OUT))
    rim = (shown & (facing.abs() < SIDEWAYS) & ~left_out).nonzero()[:, 0]
    beyond = torch.stack([
        _at(drawn, xy[rim] + far * across[rim]) for far in (-INSIDE, INSIDE, CLEAR * metre[rim])
    ])  # fmt: skip
    rim = rim[(beyond[0] > 0.5) & (beyond[1:] < 0.5).all(0)]
    rim = rim[torch.randperm(len(rim), generator=generator)[:POINTS]]
    xy, across, metre = xy[rim], across[rim], metre[rim]
    along = torch.linspace(-REACH, REACH, STEPS)
    at = xy[:, None] + (along * metre)[..., None] * across[:, None]
    seen = _at(mask, at)
    seen[~camera.shows(at, torch.ones(at.shape[:2]))] = torch.nan
    before, after = seen[:, :-1], seen[:, 1:]
    edge = (before >= 0.5) & (after < 0.5)
    part = (before - 0.5) / (before - after).clamp_min(1e-6)
    metres = torch.where(edge, along[:-1] + part * (along[1] - along[0]), torch.inf)
    nearest = metres.abs().argmin(1, keepdim=True)
    metres = metres.gather(1, nearest)
    edge_at = xy + (metres * metre).nan_to_num(posinf=0.0) * across
    outward = torch.stack([
        -_at(ndimage.gaussian_filter1d(mask, SMOOTH, axis=axis, order=1), edge_at)
        for axis in (1, 0)
    ], -1)  # fmt: skip
    alike = (torch.nn.functional.normalize(outward, dim=-1) * across).sum(-1) > ALIKE
    good = torch.isfinite(metres[:, 0]) & alike
    spreads = (SIGMA**2 + (EDGE / metre).square()).sqrt()
    return Gaps(
        rim[good], normals[rim][good].double(), metres[good, 0].double(), spreads[good, 0].double()
    )


def _normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "T 3"]) -> Float[Tensor, "V 3"]:
    """Unit normals of vertices: the mean of their faces', weighted by area."""
    a, b, c = vertices[faces].unbind(1)
    of_faces = torch.linalg.cross(b - a, c - a)[:, None].expand(-1, 3, -1).flatten(0, 1)
    normals = torch.zeros_like(vertices).index_add(0, faces.flatten(), of_faces)
    return torch.nn.functional.normalize(normals, dim=-1)


def _at(image: Float[np.ndarray, "H W"], xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Between pixels, linearly; beyond the border as at it."""
    rows, columns = xy[..., 1].numpy() - 0.5, xy[..., 0].numpy() - 0.5
    return torch.from_numpy(
        ndimage.map_coordinates(image, [rows, columns], order=1, mode="nearest")
    )


def _small(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "h w"]:
    """Shares of the pixels of a smaller image that a mask covers."""
    size = (round(mask.shape[0] * WIDTH / mask.shape[1]), WIDTH)
    shares = torch.from_numpy(mask).float()[None, None]
    return torch.nn.functional.interpolate(shares, size, mode="area")[0, 0].numpy()
