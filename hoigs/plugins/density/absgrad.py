"""density:absgrad: adaptive density control by absolute screen gradients.

AbsGS (Ye et al. 2024, arXiv:2404.10484).
"""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from hoigs.core.interfaces.density import DensityStatistics
from hoigs.plugins.density.adc import AdaptiveDensity, AdaptiveDensityConfig


class AbsoluteGradientConfig(AdaptiveDensityConfig):
    """As density:adc, with another criterion for splitting.

    AbsGS's code also sets clone_scale to 0.001, a tenth of 3DGS's.
    """

    split_threshold: float = Field(default=4e-4, gt=0)
    """Absolute gradient, in units of half the image, above which a large Gaussian is split (AbsGS's
    code: 4e-4)."""
    clone: Literal["signed", "absolute"] = "signed"
    """The gradient that `threshold` is compared with for small Gaussians, "signed" (AbsGS) or
    "absolute". gsplat's absgrad is "absolute" with 8e-4 for both thresholds."""


class AbsoluteGradientDensity(AdaptiveDensity):
    """Adaptive density control by gradients that do not cancel between the pixels of a Gaussian.

    The pixels of a large Gaussian over fine detail pull it in all directions at once. Their signed
    sum, which 3DGS compares with its threshold, is then small, and the blur stays. AbsGS sums the
    absolute values of the components over pixels before it takes the norm ("homodirectional"
    gradient), and splits by that. It needs a rasterizer with `Capabilities.absolute_gradients`.
    """

    Config: ClassVar = AbsoluteGradientConfig
    config: AbsoluteGradientConfig
    absolute_gradients = True

    def urgency(
        self, statistics: DensityStatistics, large: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        absolute = statistics.mean_absolute_gradient
        small = absolute if self.config.clone == "absolute" else statistics.mean_gradient
        split = absolute / self.config.split_threshold
        return torch.where(large, split, small / self.config.threshold)
