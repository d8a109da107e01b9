"""features:body-parts: 16 tokens of a human, one for each body part (HOIGS, Eq. 7)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.deformation import DeformationModel, ProvidesField
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Tokens


def part_averages(parts: Int[Tensor, " V"]) -> Float[Tensor, "16 V"]:
    """A matrix whose rows average the points of each part: 1 / |V_p| on V_p, else 0.

    Raises:
        ValueError: a part has no points.
    """
    member = parts[None] == torch.arange(len(PART_NAMES), device=parts.device)[:, None]
    sizes = member.sum(1, keepdim=True)
    if (sizes == 0).any():
        empty = [PART_NAMES[i] for i in (sizes.squeeze(1) == 0).nonzero().squeeze(1).tolist()]
        raise ValueError(f"no points of {', '.join(empty)}: every part needs some for its token")
    return member / sizes


class BodyPartFeatures(FeatureExtractor):
    """f_p(t) = mean over V_p of phi(x_i, y_i, z_i, t), at the centroid of the part's points.

    The mean makes tokens comparable: the head alone has more than half of SMPL-X's vertices.
    """

    requires = frozenset({"field"})
    tokens = "part"
    cuda_graph_safe = True
    averages: Tensor

    def bind(self, deformation: DeformationModel, canonical: Gaussians) -> None:
        assert isinstance(deformation, ProvidesField)
        self.width = deformation.field_width
        averages = part_averages(deformation.field_parts()).to(canonical.means)
        self.register_buffer("averages", averages, persistent=False)

    def forward(
        self, deformation: DeformationModel, canonical: Gaussians, moment: Moment
    ) -> Tokens:
        assert isinstance(deformation, ProvidesField)
        features, places = deformation.posed_field(canonical, moment)
        return Tokens(self.averages @ features, self.averages @ places)
