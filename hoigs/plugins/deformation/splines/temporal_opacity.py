"""Ex4DGS's opacity over time: 1 between two centres, with a fall-off on either side."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def log_presence(
    centers: Float[Tensor, "D 2"],
    log_widths: Float[Tensor, "D 2"],
    time: float,
    floor: float,
    *,
    jump: bool,
) -> Float[Tensor, " D"]:
    """Logarithm of the factor on each opacity: 0 between the centres, falling as a Gaussian
    outside, exp(-(distance / (exp(log width) + floor))^2) (Ex4DGS, Lee et al. 2024, eq. 8).

    Args:
        centers: in either order, in the unit of `time`. log_widths: before the first centre, and
            after the second.
        jump: as the published code has it, the distance before the first centre is measured from
            the second one, so that the factor jumps to 1 at the first.
    """
    first, last = centers.amin(1), centers.amax(1)
    widths = log_widths.exp() + floor
    before, after = first - time, time - last
    early = (last - time if jump else before) / widths[:, 0]
    late = after / widths[:, 1]
    zero = torch.zeros_like(first)
    distance = torch.where(before > 0, early, torch.where(after > 0, late, zero))
    return -distance.square()


def scaled_logits(
    logits: Float[Tensor, " D"], log_factor: Float[Tensor, " D"]
) -> Float[Tensor, " D"]:
    """Logits of sigmoid(logits) * exp(log_factor), for factors of at most 1; finite throughout."""
    product = torch.nn.functional.logsigmoid(logits) + log_factor
    # log(p / (1 - p)) of p = exp(product); where the factor is 1 this is the logit itself
    capped = product.clamp(max=-1e-6)
    return torch.where(log_factor == 0, logits, capped - torch.log(-torch.expm1(capped)))
