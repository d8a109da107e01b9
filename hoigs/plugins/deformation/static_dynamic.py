"""deformation:static-dynamic: Gaussians that sort themselves into a static and a moving set
(D2NeRF, Wu et al. 2022, on Gaussians)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.context import BuildContext
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import normalize_quats
from hoigs.plugins.deformation.deltas import with_residual
from hoigs.plugins.deformation.se3_field import Se3Field, Se3FieldConfig


class StaticDynamicConfig(Se3FieldConfig):
    """Nerfies' field for the moving set.

    Attributes:
        share: of each Gaussian in the moving set at the start.
        skew: exponent k of the entropy H(share^k); above 1 it leans towards the static set.
        entropy_from: weight of the entropy at the start, as a share of that at the end, which it
            reaches log-linearly (D2NeRF: 1e-4 to 1e-2).
    """

    share: float = Field(0.5, gt=0, lt=1)
    skew: float = Field(1.75, ge=1)
    entropy_from: float = Field(0.01, gt=0, le=1)


class StaticDynamic(Se3Field):
    """x -> x + s (W(x, t) - x): W is `Se3Field`, s in [0, 1] each Gaussian's own learned share.

    D2NeRF adds two fields and presses the dynamic share of each point's density to 0 or 1. Here the
    share is a Gaussian's: at 0 it never moves, at 1 it goes where the field takes it, and the same
    skewed entropy sorts them.

    Args:
        share, skew, entropy_from: as StaticDynamicConfig. The others are Se3Field's.
    """

    per_gaussian = ("share_logits",)
    rates: ClassVar[Mapping[str, str]] = {"share_logits": "opacity"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {"elastic": 1e-3, "entropy": 1e-2}

    share_logits: nn.Parameter

    def __init__(
        self,
        times: Sequence[float],
        *,
        share: float = 0.5,
        skew: float = 1.75,
        entropy_from: float = 0.01,
        **field: Any,
    ) -> None:
        super().__init__(times, **field)
        self.share, self.skew, self.entropy_from = share, skew, entropy_from

    @classmethod
    def from_config(cls, config: Se3FieldConfig, context: BuildContext) -> Self:
        if context.clip is None:
            raise ValueError(
                "deformation:static-dynamic needs a clip: it has a code per trained frame"
            )
        return super().from_config(config, context)

    def bind(self, rest: Gaussians) -> None:
        super().bind(rest)
        start = math.log(self.share / (1 - self.share))
        self.share_logits = nn.Parameter(torch.full_like(rest.opacity_logits.detach(), start))

    @property
    def shares(self) -> Float[Tensor, " N"]:
        """How far each Gaussian belongs to the moving set, 0 to 1."""
        return torch.sigmoid(self.share_logits)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = super().forward(rest, moment)
        share = self.shares[:, None]
        before = normalize_quats(rest.quats)
        after = torch.where((before * moved.quats).sum(-1, keepdim=True) < 0, -1, 1) * moved.quats
        out = replace(
            moved,
            means=torch.lerp(rest.means, moved.means, share),
            quats=normalize_quats(torch.lerp(before, after, share)),
        )
        return with_residual(out, residual)

    def entropy(self) -> Float[Tensor, ""]:
        """Mean of H(s^k), nats: D2NeRF's skewed entropy (sec. 3.3)."""
        powered = self.shares.pow(self.skew).clamp(1e-6, 1 - 1e-6)
        surprise = powered * powered.log() + (1 - powered) * (1 - powered).log()
        return -surprise.mean()

    def regularizers(self) -> dict[str, Tensor]:
        """As Se3Field, and "entropy" of the shares, on its way to full weight."""
        ramp = self.entropy_from ** (1 - self.progress)
        return super().regularizers() | {"entropy": ramp * self.entropy()}
