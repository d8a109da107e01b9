"""features:body-parts: 16 tokens of a human, one a body part (HOIGS, Sec. "Feature Extraction")."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.body import PART_NAMES
from hoigs.core.config import ComponentConfig
from hoigs.core.deformation import DeformationModel, ProvidesField
from hoigs.core.features import FeatureExtractor, Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment


class BodyPartConfig(ComponentConfig):
    """Nothing to set: the width is that of the deformation's field (the paper's 96)."""


def part_averages(parts: Int[Tensor, " V"]) -> Float[Tensor, "16 V"]:
    """Rows that average the points of each part: 1 / |V_p| on V_p.

    Raises:
        ValueError: a part without points has no mean.
    """
    member = parts[None] == torch.arange(len(PART_NAMES), device=parts.device)[:, None]
    sizes = member.sum(1, keepdim=True)
    if (sizes == 0).any():
        empty = [PART_NAMES[i] for i in (sizes.squeeze(1) == 0).nonzero().squeeze(1).tolist()]
        raise ValueError(f"no points of {', '.join(empty)}: every part needs some for its token")
    return member / sizes


class BodyPartFeatures(FeatureExtractor):
    """f_p(t) = mean over V_p of phi(x_i, y_i, z_i, t), at the centroid of the part's points.

    Means, not sums: the head alone has more than half of SMPL-X's vertices (methods C.9).
    """

    requires = frozenset({"field"})
    recordable = True
    averages: Tensor

    def bind(self, deformation: DeformationModel, rest: Gaussians) -> None:
        assert isinstance(deformation, ProvidesField)
        self.width = deformation.field_width
        averages = part_averages(deformation.field_parts()).to(rest.means)
        self.register_buffer("averages", averages, persistent=False)

    def forward(self, deformation: DeformationModel, rest: Gaussians, moment: Moment) -> Tokens:
        assert isinstance(deformation, ProvidesField)
        features, places = deformation.posed_field(rest, moment)
        return Tokens(self.averages @ features, self.averages @ places)
