"""features:embedding: plain learnable tokens, the paper's ablation "w/o human feature"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.body import PART_NAMES
from hoigs.core.config import ComponentConfig
from hoigs.core.deformation import DeformationModel, ProvidesField
from hoigs.core.features import FeatureExtractor, Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.core.spline import linear
from hoigs.plugins.features.body_parts import part_averages


class EmbeddingConfig(ComponentConfig):
    """The ablation's size.

    Attributes:
        tokens: how many; None is one a body part where the deformation knows them, else one a
            Gaussian. width: of each.
        keyframes: None is one embedding for all time; else as many, uniform over the clip and
            linear between. The paper says neither; None, the default, is the plainer ablation.
    """

    tokens: int | None = Field(None, ge=1)
    width: int = Field(96, ge=1)
    keyframes: int | None = Field(None, ge=2)


class EmbeddingFeatures(FeatureExtractor):
    """Tokens that know nothing of place, and of time only with `keyframes`.

    Their positions, which the interaction measures its distances from, are the centroids of the
    16 body parts, or each Gaussian's centre, or, for any other number of tokens, the entity's
    centre. Positions carry no gradient.
    """

    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding"}
    recordable = True
    averages: Tensor | None

    def __init__(
        self, tokens: int | None = None, width: int = 96, keyframes: int | None = None
    ) -> None:
        super().__init__()
        self.tokens, self.width, self.keyframes = tokens, width, keyframes
        self.per_gaussian = ()

    def bind(self, deformation: DeformationModel, rest: Gaussians) -> None:
        parts = "field" in deformation.provides and self.tokens in (None, len(PART_NAMES))
        averages = None
        if parts:
            assert isinstance(deformation, ProvidesField)
            averages = part_averages(deformation.field_parts()).to(rest.means)
        self.register_buffer("averages", averages, persistent=False)
        count = self.tokens or (len(PART_NAMES) if parts else len(rest))
        shape = (
            (count, self.width) if self.keyframes is None else (count, self.keyframes, self.width)
        )
        self.embedding = nn.Parameter(0.1 * torch.randn(shape).to(rest.means))
        if self.tokens is None and not parts:
            self.per_gaussian = ("embedding",)

    @torch.no_grad()
    def _positions(
        self, deformation: DeformationModel, rest: Gaussians, moment: Moment
    ) -> Float[Tensor, "M 3"]:
        if self.averages is not None:
            assert isinstance(deformation, ProvidesField)
            return self.averages @ deformation.posed_field(rest, moment)[1]
        means = deformation(rest, moment).means
        return means if self.per_gaussian else means.mean(0).expand(len(self.embedding), 3)

    def forward(self, deformation: DeformationModel, rest: Gaussians, moment: Moment) -> Tokens:
        features: Tensor = self.embedding
        if self.keyframes is not None:
            features = linear(features, moment.time)
        return Tokens(features, self._positions(deformation, rest, moment))
