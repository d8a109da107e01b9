"""Shared by the controllers: the window of refinements, clones, split children and draws."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor

from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange


@dataclass(frozen=True)
class Window:
    """The steps at which there are refinements.

    Attributes:
        start, stop: bounds of the window, fractions of all steps. interval: steps between
            refinements.
    """

    start: float
    stop: float
    interval: int

    def contains(self, step: int, total_steps: int) -> bool:
        return self.start * total_steps <= step <= self.stop * total_steps

    def refines(self, step: int, total_steps: int) -> bool:
        return self.contains(step, total_steps) and step > 0 and step % self.interval == 0

    def left(self, step: int, total_steps: int) -> int:
        """The number of refinements from `step` on, `step` included."""
        first = max(step, math.ceil(self.start * total_steps), 1)
        last = min(math.floor(self.stop * total_steps), total_steps)
        return max(0, last // self.interval - (first - 1) // self.interval)


def with_children(
    canonical: Gaussians,
    kept: Bool[Tensor, " N"],
    extra: Int[Tensor, " N"],
    large: Bool[Tensor, " N"],
    generator: torch.Generator,
) -> tuple[TopologyChange, Gaussians]:
    """The kept Gaussians and `extra` more of each, as in 3DGS (Kerbl et al. 2023, Sec. 5.2).

    Small ones stay and are cloned in place. A large one is split: extra + 1 children, drawn from
    it, with standard deviations divided by 0.8 (extra + 1) (1.6 for two), replace it. Order of the
    result: Gaussians that stay, clones, children.

    Args:
        kept: which are not pruned. extra: Gaussians added for each (read where kept). large: which
            are split rather than cloned.

    Returns:
        The index map, with offsets in canonical space, and the new canonical Gaussians.
    """
    extra = torch.where(kept, extra, 0)
    split = large & (extra > 0)
    rows = torch.arange(len(canonical), device=kept.device)
    stay = rows[kept & ~split]
    clones = rows[~split].repeat_interleave(extra[~split])
    children = rows[split].repeat_interleave(extra[split] + 1)
    source = torch.cat((stay, clones, children))
    order = torch.arange(len(source), device=source.device)
    fresh, drawn = order >= len(stay), order >= len(stay) + len(clones)
    taken = canonical[source]
    offsets = drawn[:, None] * drawn_offsets(taken, generator)
    shrink = drawn * (0.8 * (extra[source] + 1)).log()
    born = taken.replace(means=taken.means + offsets, log_scales=taken.log_scales - shrink[:, None])
    return TopologyChange(source, fresh, offsets), born


def drawn_offsets(gaussians: Gaussians, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """An offset from the centre of each Gaussian, distributed as the Gaussian itself."""
    means = gaussians.means
    normal = torch.randn(means.shape, generator=generator, device=means.device, dtype=means.dtype)
    local = normal * gaussians.scales
    return (quats_to_matrices(gaussians.quats) @ local[..., None]).squeeze(-1)


def drawn_rows(
    weights: Float[Tensor, " N"], count: int, generator: torch.Generator
) -> Int[Tensor, " count"]:
    """Rows drawn with replacement, with probabilities proportional to `weights` >= 0.

    At least one weight must be positive. (torch.multinomial takes no more than 2^24 rows.)
    """
    edges = weights.double().cumsum(0)
    points = torch.rand(count, generator=generator, device=weights.device, dtype=torch.float64)
    found = torch.searchsorted(edges, points * edges[-1], right=True)
    return found.clamp_max(len(weights) - 1)


# The cap "auto": as many Gaussians as the frames of a clip can resolve.

PER_PIXEL = 0.57  # Gaussians a pixel: up to here, real clips of 0.18 to 0.23 megapixels improve
LEAST, MOST = 10_000, 1_000_000

# a number, "auto", "auto/2" for half as many, or "auto+14000" for an entity that shows more
AUTO = r"^auto(/[1-9]\d*)?(\+\d+)?$"
Cap = Annotated[int, Field(ge=1)] | Annotated[str, Field(pattern=AUTO)]


def resolve_cap(cap: int | str, clip: Clip | None) -> int:
    """`cap` as a number.

    "auto" is 0.57 Gaussians for each pixel of a frame, from 10,000 to 1,000,000; "auto/D" is the
    D-th part of that, and "auto+N" is N more.

    Raises:
        ValueError: "auto" without a clip.
    """
    if isinstance(cap, int):
        return cap
    if clip is None:
        raise ValueError(
            f'cap "{cap}" depends on the frame size of a clip, and no clip is given; set a number'
        )
    camera = clip.cameras[0]
    base = min(max(int(PER_PIXEL * camera.width * camera.height), LEAST), MOST)
    part, _, more = cap.partition("+")
    return base // int(part.partition("/")[2] or 1) + int(more or 0)
