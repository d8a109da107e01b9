"""Replacing a Gaussian by several coinciding ones that look the same (3DGS-MCMC, Eq. 9)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import share_opacity

MAX_COPIES = 51  # as published: of more copies the alternating sum would overflow

# BINOMIALS[n, k] = C(n, k); all are below 2^53
BINOMIALS = torch.tensor(
    [[math.comb(n, k) for k in range(MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)],
    dtype=torch.float64,
)


def relocation_shrink(
    opacities: Float[Tensor, " M"], copies: Int[Tensor, " M"]
) -> Float[Tensor, " M"]:
    """Factor by which standard deviations change when a Gaussian becomes n coinciding ones.

    With o' = 1 - (1 - o)^(1 / n), Eq. 9 keeps the integral of alpha along a line
    through the centre. Its double sum is, by the hockey-stick identity sum_i C(i - 1, k) =
    C(n, k + 1), the single one used here:

        sigma' / sigma = o / sum_{k=1}^n C(n, k) (-1)^(k-1) o'^k / sqrt(k)

    Computed in float64; 1 where n is 1.

    Args:
        opacities: o, of the Gaussian before. copies: n, at most MAX_COPIES.
    """
    o = opacities.double().clamp(1e-12, 1.0 - 1e-7)
    shared = -torch.expm1(torch.log1p(-o) / copies)
    k = torch.arange(1, MAX_COPIES + 1, device=o.device, dtype=torch.float64)
    signs = 1.0 - 2.0 * ((k - 1) % 2)
    binomials = BINOMIALS.to(o.device)[copies, 1:]  # zero beyond n, so that terms end there
    total = (binomials * signs * shared[:, None] ** k / k.sqrt()).sum(1)
    return torch.where(copies > 1, o / total, 1.0).to(opacities.dtype)


def shared_among(gaussians: Gaussians, copies: Int[Tensor, " M"], min_opacity: float) -> Gaussians:
    """Each row as one of `copies` coinciding Gaussians that together look like it before.

    Args:
        copies: n of each row, at most MAX_COPIES; rows with one stay. min_opacity: lowest opacity
            of a row with several.
    """
    several = copies > 1
    low, high = math.log(min_opacity / (1 - min_opacity)), -math.log(torch.finfo(torch.float32).eps)
    logits = share_opacity(gaussians.opacity_logits, copies).clamp(low, high)
    log_scales = gaussians.log_scales.clone()
    rows = several.nonzero().squeeze(1)
    shrink = relocation_shrink(gaussians.opacities[rows], copies[rows])
    log_scales[rows] += shrink.log()[:, None]
    return gaussians.replace(
        opacity_logits=torch.where(several, logits, gaussians.opacity_logits),
        log_scales=log_scales,
    )
