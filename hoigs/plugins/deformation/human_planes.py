"""f and psi_h of HOIGS (Eq. 5 and 7): a human's feature planes, and their canonical attributes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.maths.feature_planes import PairedPlanes, ProductPlanes
from hoigs.core.parameters import zeroed

Fusion = Literal["paired", "product"]
FRACTIONS = (4, 2, 1)  # of the finest resolution: three scales of 32 channels are 96 again


def body_planes(
    fusion: Fusion, channels: int, resolution: int, time_resolution: int
) -> PairedPlanes | ProductPlanes:
    """The planes of a human, 3 * channels wide; see HexPlaneSkinningConfig.fusion."""
    if fusion == "paired":
        return PairedPlanes(channels, resolution, time_resolution)
    sizes = [max(2, resolution // fraction) for fraction in FRACTIONS]
    # a product of three values near 0.45 varies as much as a single value of paired planes
    return ProductPlanes(channels, sizes, time_resolution, spread=(0.1, 0.8))


def field_subset(vertex_parts: Int[Tensor, " V"], count: int) -> Int[Tensor, " S"]:
    """About `count` vertices, equally many of each of the 16 parts, spread evenly by index.

    Raises:
        ValueError: a part has no vertex, and so the human would lack its token.
    """
    chosen = []
    for part, name in enumerate(PART_NAMES):
        rows = (vertex_parts == part).nonzero().squeeze(1)
        if len(rows) == 0:
            raise ValueError(f"the body has no vertex of part {part} ({name})")
        wanted = min(len(rows), -(-count // len(PART_NAMES)))
        picks = torch.linspace(0, len(rows) - 1, wanted, device=rows.device).round().long()
        chosen.append(rows[picks])
    return torch.cat(chosen)


# psi_h: canonical features to Gaussian attributes (HOIGS, Eq. 5).

HeadKind = Literal["full", "exavatar"]


@dataclass(frozen=True)
class CanonicalAttributes:
    """What a network predicts for N canonical points; None leaves an attribute as it is.

    Attributes:
        offsets: metres, canonical. log_scales: added to the raw values.
        colors: added to RGB (CanonicalHead), or RGB before it is squashed (decoders).
        quats: offset from the identity, as GaussianDelta has it (CanonicalHead), or unit rotations
            (decoders).
        opacity_logits: added to the raw values.
        weights: added to the logarithm of the body's own skinning weights.
    """

    offsets: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"] | None = None
    opacity_logits: Float[Tensor, " N"] | None = None
    weights: Float[Tensor, "N J"] | None = None


class CanonicalHead(nn.Module):
    """psi_h(f(T_c)) = (c, o, dP_c, R, S, W), one MLP; it starts by changing nothing.

    Args:
        features: width of the input. joints: joint count. width: width of the two hidden layers.
        kind: "full" is HOIGS, Eq. 5; "exavatar" predicts only colour, offset and one isotropic
            scale, as ExAvatar does, on which HOIGS builds.
    """

    def __init__(self, features: int, joints: int, width: int, kind: HeadKind) -> None:
        super().__init__()
        self.sizes = [3, 3, 3, 4, 1, joints] if kind == "full" else [3, 3, 1]
        self.layers = nn.Sequential(
            nn.Linear(features, width),
            nn.ReLU(inplace=True),
            nn.Linear(width, width),
            nn.ReLU(inplace=True),
            zeroed(nn.Linear(width, sum(self.sizes))),
        )

    def forward(self, features: Float[Tensor, "N F"]) -> CanonicalAttributes:
        colors, offsets, scales, *others = self.layers(features).split(self.sizes, dim=-1)
        # offsets are in units of 10 cm: at the learning rate of colours, metres would diverge
        made = CanonicalAttributes(0.1 * offsets, scales.expand(-1, 3), colors)
        if not others:
            return made
        quats, opacity_logits, weights = others
        return replace(
            made, quats=quats, opacity_logits=opacity_logits.squeeze(-1), weights=weights
        )
