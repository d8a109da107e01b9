"""psi_h: canonical features to Gaussian attributes (HOIGS, Sec. "Human Deformation")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

HeadKind = Literal["full", "exavatar"]


@dataclass(frozen=True)
class CanonicalAttributes:
    """What psi_h says of N canonical points; None where the head leaves it to the template.

    Attributes:
        colors: added to RGB. offsets: metres, canonical. log_scales: added to the raw values.
        quats: offset from the identity, as GaussianDelta. opacity_logits: added to the raw ones.
        weights: added to the logarithm of the template's skinning weights.
    """

    colors: Float[Tensor, "N 3"]
    offsets: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"] | None = None
    opacity_logits: Float[Tensor, " N"] | None = None
    weights: Float[Tensor, "N J"] | None = None


class CanonicalHead(nn.Module):
    """One MLP for all attributes; its last layer starts at zero, so the body starts as template.

    Args:
        features: width of its input. joints: of the body. width: of its two hidden layers.
        kind: "full" is the paper's (c, o, dP, R, S, W); "exavatar" predicts only colour, offset
            and one isotropic scale, as the code that it builds on does (methods A.4).
    """

    def __init__(self, features: int, joints: int, width: int, kind: HeadKind) -> None:
        super().__init__()
        self.sizes = [3, 3, 3, 4, 1, joints] if kind == "full" else [3, 3, 1]
        self.layers = nn.Sequential(
            nn.Linear(features, width),
            nn.ReLU(inplace=True),
            nn.Linear(width, width),
            nn.ReLU(inplace=True),
            nn.Linear(width, sum(self.sizes)),
        )
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, features: Float[Tensor, "N F"]) -> CanonicalAttributes:
        parts = self.layers(features).split(self.sizes, dim=-1)
        # offsets in units of 10 cm: a learning rate fit for colours would fling the points
        colors, offsets, scales = parts[0], 0.1 * parts[1], parts[2].expand(-1, 3)
        if len(parts) == 3:
            return CanonicalAttributes(colors, offsets, scales)
        return CanonicalAttributes(
            colors, offsets, scales, parts[3], parts[4].squeeze(-1), parts[5]
        )
