"""Pruning of Gaussians by how much each changes the rendered images.

Removing Gaussian i changes a pixel by T a c - T a C_behind, which is linear in its opacity: the
derivative by a factor s on the opacity is the whole change (but for the cut-offs of compositing).
The squared change, summed over pixels and channels, is the pruning score of PUP 3D-GS (Hanson et
al. 2025, arXiv:2406.10219) and Speedy-Splat (Hanson et al. 2025, arXiv:2412.00578), here of the
opacity alone. It is estimated with random signs v: E (d(v . C) / ds)^2 = sum (dC / ds)^2.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.core.values.topology import TopologyChange
from hoigs.studies.needs.validator import Scores, Validator

KEEP = 16  # fewest Gaussians that an entity keeps
HALVINGS = 5  # of the interval of counts
SURE = 1e-4  # least 1 - opacity: the derivative by the logit vanishes at one


def sensitivities(
    model: SceneModel, clip: Clip, positions: Sequence[int], *, probes: int = 1, seed: int = 0
) -> dict[str, Float[Tensor, " N"]]:
    """By entity, how much removing each Gaussian changes the images: squared error, summed over
    pixels, channels and frames. Gaussians that are visible in no frame have 0.

    Args:
        positions: of the frames that are rendered. probes: vectors of random signs for each frame.
    """
    generator = torch.Generator().manual_seed(seed)
    total: Tensor | None = None
    rows: dict[str, slice] = {}
    for position in positions:
        moment, camera = clip.moments[position], clip.cameras[position]
        with torch.no_grad():
            state = model(moment.to(model.device))
            joined = state.joined()
        rows = state.slices()
        logits = joined.opacity_logits.detach().requires_grad_()
        drawn = model.draw(
            joined.replace(opacity_logits=logits), camera.to(model.device), RenderRequest()
        ).color
        clear = (1 - torch.sigmoid(logits.detach())).clamp_min(SURE)
        squares = torch.zeros_like(clear)
        for probe in range(probes):
            signs = torch.randint(0, 2, drawn.shape, generator=generator).to(drawn) * 2 - 1
            last = probe == probes - 1
            (slope,) = torch.autograd.grad((drawn * signs).sum(), logits, retain_graph=not last)
            squares += (slope / clear).square() / probes  # d / ds = d / dlogit / (1 - o)
        total = squares if total is None else total + squares
    if total is None:
        raise ValueError("sensitivities need at least one frame")
    return {name: total[row] for name, row in rows.items()}


def removable_rows(
    validator: Validator,
    model: SceneModel,
    name: str,
    scores: Float[Tensor, " N"],
    before: Scores,
    visible: float,
) -> tuple[Int[Tensor, " L"], float]:
    """The most Gaussians of an entity, in order of sensitivity, whose removal costs at most
    `visible` dB in any region, and what it costs; by bisection, as far as the budget allows."""
    order = scores.argsort(stable=True)
    slices, start = {}, 0
    for entity, count in model.count().items():
        slices[entity] = slice(start, start + count)
        start += count
    everything = torch.ones(start, dtype=torch.bool, device=scores.device)
    fine, too_many, cost = 0, max(0, len(order) - KEEP) + 1, 0.0
    for _ in range(HALVINGS):
        count = (fine + too_many) // 2
        if count == fine or not validator.affordable:
            break
        subset = everything.clone()
        subset[slices[name].start + order[:count]] = False
        drop = before.drop_to(validator.score(model, subset))
        if drop <= visible:
            fine, cost = count, drop
        else:
            too_many = count
    return order[:fine], cost


@torch.no_grad()
def remove_rows(model: SceneModel, name: str, rows: Int[Tensor, " L"]) -> None:
    """Remove rows of an entity, also from its deformation and features."""
    entity = model.entity(name)
    mask = torch.ones(len(entity), dtype=torch.bool, device=entity.means.device)
    mask[rows] = False
    entity.apply_topology(TopologyChange.keep(mask), entity.canonical[mask])
