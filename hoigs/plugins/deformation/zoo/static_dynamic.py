"""deformation:static-dynamic: Gaussians that learn whether they move (D2NeRF, Wu et al. 2022,
arXiv:2205.15838, on Gaussians).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.maths.rotations import normalize_quats
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.fields import with_residual
from hoigs.plugins.deformation.zoo.se3_field import Se3Field, Se3FieldConfig


class StaticDynamicConfig(Se3FieldConfig):
    """Nerfies' field for the moving set."""

    share: float = Field(default=0.5, gt=0, lt=1)
    """How far each Gaussian belongs to the moving set at the start."""
    skew: float = Field(default=1.75, ge=1)
    """Exponent k of the entropy H(share^k); above 1 it favours the static set."""
    entropy_from: float = Field(default=0.01, gt=0, le=1)
    """Weight of the entropy at the start, as a fraction of that at the end, which it reaches
    log-linearly (D2NeRF: 1e-4 to 1e-2)."""


class StaticDynamic(Se3Field):
    """x -> x + s (W(x, t) - x): W is `Se3Field`, s in [0, 1] each Gaussian's own learned share.

    D2NeRF adds two fields and drives the dynamic share of each point's density to 0 or 1. Here the
    share is a Gaussian's: at 0 it never moves, at 1 it moves as the field does, and the same skewed
    entropy drives it to either.
    """

    Config: ClassVar = StaticDynamicConfig
    per_gaussian = ("share_logits",)
    rates: ClassVar[Mapping[str, str]] = {"share_logits": "opacity"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {"elastic": 1e-3, "entropy": 1e-2}

    share_logits: nn.Parameter

    def bind(self, canonical: Gaussians) -> None:
        super().bind(canonical)
        start = math.log(self.config.share / (1 - self.config.share))
        self.share_logits = nn.Parameter(torch.full_like(canonical.opacity_logits.detach(), start))

    @property
    def shares(self) -> Float[Tensor, " N"]:
        """How far each Gaussian belongs to the moving set, 0 to 1."""
        return torch.sigmoid(self.share_logits)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = super().forward(canonical, moment)
        share = self.shares[:, None]
        before = normalize_quats(canonical.quats)
        after = torch.where((before * moved.quats).sum(-1, keepdim=True) < 0, -1, 1) * moved.quats
        out = replace(
            moved,
            means=torch.lerp(canonical.means, moved.means, share),
            quats=normalize_quats(torch.lerp(before, after, share)),
        )
        return with_residual(out, residual)

    def entropy(self) -> Float[Tensor, ""]:
        """Mean of H(s^k), nats: D2NeRF's skewed entropy."""
        powered = self.shares.pow(self.config.skew).clamp(1e-6, 1 - 1e-6)
        negative = powered * powered.log() + (1 - powered) * (1 - powered).log()
        return -negative.mean()

    def regularizers(self) -> dict[str, Tensor]:
        """Those of Se3Field, and "entropy" of the shares, whose weight grows over the run."""
        ramp = self.config.entropy_from ** (1 - self.progress)
        return super().regularizers() | {"entropy": ramp * self.entropy()}
