"""Scene points to start from, for layouts that come without a point cloud."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import FrameStore

Points = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]
SOURCES = 8  # frames that are read
FARTHEST = 1e7  # metres, as in clip folders


def points_in_box(count: int, reach: float) -> Points:
    """Grey points at random, with coordinates between -reach and reach."""
    places = np.random.default_rng(0).uniform(-reach, reach, (count, 3))
    points = torch.from_numpy(places).float()
    return points, torch.full_like(points, 0.5)


def points_of_depth(
    store: FrameStore,
    cameras: Sequence[Camera],
    entities: Sequence[str],
    count: int = 20_000,
    seed: int = 0,
) -> Points | None:
    """Scene pixels of a few frames, back-projected; world metres and RGB in [0, 1].

    Returns:
        None if no scene pixel of those frames has a depth.
    """
    rng = np.random.default_rng(seed)
    sources = _sources(len(cameras))
    parts = []
    for position in sources:
        depth = store.depth(position)
        if depth is not None:
            where = _scene(store, entities, position, depth.shape) & (depth > 0)
            parts.append(_lifted(store, cameras, position, where, depth, count, rng, len(sources)))
    points, colors = (torch.cat(x) for x in zip(*parts)) if parts else (torch.zeros(0, 3),) * 2
    return (points, colors) if len(points) else None


def points_along_rays(
    store: FrameStore,
    cameras: Sequence[Camera],
    entities: Sequence[str],
    span: tuple[float, float],
    count: int = 20_000,
    seed: int = 0,
) -> Points:
    """Points at random depths behind the scene's pixels, with their colours: a start where nothing
    is known of the scene's shape; training moves them.

    Args:
        span: nearest and farthest depth, metres; inverse depth is uniform between them.

    Raises:
        ClipError: the span makes no sense, since the cameras or what they look at do not.
    """
    if not 1 / FARTHEST < span[0] <= span[1] < FARTHEST:
        raise ClipError(
            f"the scene would begin {span[0]:.3g} to {span[1]:.3g} m away from the cameras: their "
            "poses, or what places the scene, are wrong"
        )
    rng = np.random.default_rng(seed)
    sources = _sources(len(cameras))
    parts = []
    for position in sources:
        camera = cameras[position]
        where = _scene(store, entities, position, (camera.height, camera.width))
        inverse = rng.uniform(1 / span[1], 1 / span[0], where.shape)
        depth = torch.from_numpy(1 / inverse).float()
        parts.append(_lifted(store, cameras, position, where, depth, count, rng, len(sources)))
    points, colors = (torch.cat(x) for x in zip(*parts))
    return points, colors


def _sources(frames: int) -> list[int]:
    spread = np.linspace(0, frames - 1, min(SOURCES, frames)).round().astype(int)
    return sorted(set(spread.tolist()))


def _scene(
    store: FrameStore, entities: Sequence[str], position: int, shape: tuple[int, ...]
) -> Tensor:
    """Scene pixels: those that neither belong to an entity nor are ignored."""
    taken = torch.zeros(shape, dtype=torch.bool)
    for name in entities:
        taken |= store.mask(name, position)
    ignored = store.ignored(position)
    return ~taken if ignored is None else ~(taken | ignored)


def _lifted(
    store: FrameStore,
    cameras: Sequence[Camera],
    position: int,
    where: Tensor,
    depth: Tensor,
    count: int,
    rng: np.random.Generator,
    sources: int,
) -> Points:
    rows = np.flatnonzero(where.numpy())
    chosen = torch.from_numpy(rng.choice(rows, min(-(-count // sources), len(rows)), replace=False))
    camera = cameras[position]
    grid = camera.pixel_grid().reshape(-1, 2)[chosen]
    points = camera.unproject(grid, depth.reshape(-1)[chosen])
    return points, store.image(position).reshape(-1, 3)[chosen].float() / 255
