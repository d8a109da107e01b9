"""How far landmarks are off, estimated from what a fit leaves of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

OUTLIER = 3.0  # standard deviations at which a residual begins to count as an outlier
LEAST_METRES = 0.02  # no 3D landmark is known better
FITTED = 0.4  # share of the observations that the unknowns of the fit use up
MEDIANS = {1: 0.455, 2: 1.386}  # of the chi-squared distributions of one and two components
LEAST = 30  # residuals that an estimate needs


@dataclass(frozen=True)
class Noise:
    """Standard deviations of each landmark, a component: in pixels, and in metres along the
    camera's axes, where depth is known worse than the others."""

    pixels: Float[Tensor, " L"]
    space: Float[Tensor, "L 3"]

    def seen(
        self,
        pixels: tuple[Float[Tensor, "F L 2"], Float[Tensor, "F L"]],
        space: tuple[Float[Tensor, "F L 3"], Float[Tensor, "F L"]],
        least: float,
    ) -> Noise:
        """Estimated anew from residuals and the weights of their visibility.

        Args:
            least: pixels below which no estimate goes.
        """
        residuals, visible = space
        across = _estimated(residuals[..., :2], visible, self.space[:, 0], LEAST_METRES)
        away = _estimated(residuals[..., 2:], visible, self.space[:, 2], LEAST_METRES)
        return Noise(
            _estimated(*pixels, self.pixels, least),
            torch.stack((across, across, away), -1),
        )


def _estimated(
    residuals: Float[Tensor, "F K C"], visible: Float[Tensor, "F K"], before: Tensor, least: float
) -> Float[Tensor, " K"]:
    """By the median of squares, in parts of the variance; what few landmarks show is drawn to what
    all do."""
    known = visible > 0.5
    if int(known.sum()) < LEAST:
        return before
    components = residuals.shape[-1]
    squares = residuals.square().sum(-1)
    nothing = torch.full_like(squares, torch.nan)
    squares = torch.where(known, squares, nothing) / MEDIANS[components]
    of_all = squares.flatten().nanmedian()
    counts = known.sum(0)
    single = torch.where(counts > 0, squares.nanmedian(0).values.nan_to_num(), of_all)
    variance = (counts * single + LEAST * of_all) / (counts + LEAST) / (1 - FITTED)
    return variance.clamp_min(least**2).sqrt()


def robust_weights(
    squares: Float[Tensor, "*batch"], widen: float
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Cost and weight of squared residuals in standard deviations (Geman and McClure 1987).

    Args:
        widen: factor of the distance at which an outlier begins.
    """
    spread = (OUTLIER * widen) ** 2
    return spread * squares / (squares + spread), (spread / (squares + spread)).square()
