"""density:absgrad: density control on absolute screen gradients (AbsGS, Ye et al. 2024)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from hoigs.core.density import DensityStatistics
from hoigs.plugins.density.adc import AdaptiveDensity, AdaptiveDensityConfig


class AbsoluteGradientConfig(AdaptiveDensityConfig):
    """As density:adc, with a criterion of its own for what is large.

    Attributes:
        split_threshold: absolute gradient, in units of half the image, above which a large
            Gaussian is split (AbsGS's code: 4e-4).
        clone: what `threshold` is compared with for small ones: the "signed" gradient (AbsGS) or
            the "absolute" one. gsplat's absgrad is clone: absolute, and 8e-4 for both thresholds.

    AbsGS's code also has clone_scale 0.001, ten times less than 3DGS.
    """

    split_threshold: float = Field(4e-4, gt=0)
    clone: Literal["signed", "absolute"] = "signed"


class AbsoluteGradientDensity(AdaptiveDensity):
    """3DGS's density control where the pulls of pixels on one Gaussian do not cancel.

    A large Gaussian over fine detail is pulled by its pixels in all directions at once; the
    signed sum that 3DGS looks at is then small, and the blur stays. AbsGS sums the components'
    absolute values over pixels before it takes the norm ("homodirectional" gradient), and splits
    by that. Needs a rasterizer that gives `RenderRequest.absolute_gradients`.

    Args: as AbsoluteGradientConfig. seed: of the children's places.
    """

    absolute_gradients = True

    def __init__(
        self,
        *,
        split_threshold: float = 4e-4,
        clone: Literal["signed", "absolute"] = "signed",
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        self.split_threshold, self.clone = split_threshold, clone

    def urgency(
        self, statistics: DensityStatistics, large: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        absolute = statistics.mean_absolute_gradient
        small = absolute if self.clone == "absolute" else statistics.mean_gradient
        return torch.where(large, absolute / self.split_threshold, small / self.threshold)
