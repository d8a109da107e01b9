"""features:embedding: learnable tokens, the ablation "w/o human feature" of HOIGS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.deformation import DeformationModel, ProvidesField
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.maths.splines import keyframe_position, linear
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Tokens
from hoigs.plugins.features.body_parts import part_averages


class EmbeddingConfig(ComponentConfig):
    """The number and the width of the tokens."""

    tokens: int | None = Field(default=None, ge=1)
    """Number of tokens; None is one for each body part if the deformation has parts, else one for
    each Gaussian."""
    width: int = Field(default=96, ge=1)
    """Width of each token."""
    keyframes: int | None = Field(default=None, ge=2)
    """Number of embeddings of each token, uniform over the clip and linear between; None is one for
    all time. The paper does not specify it; None is the plainer ablation."""


class EmbeddingFeatures(FeatureExtractor):
    """Tokens that depend neither on place nor, without `keyframes`, on time.

    Their positions, for the distances of the interaction, are the centroids of the 16 body parts,
    or each Gaussian's mean, or, for any other number of tokens, the centre of the entity.
    Positions have no gradient.
    """

    Config: ClassVar = EmbeddingConfig

    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding"}
    cuda_graph_safe = True
    averages: Tensor | None

    def __init__(self, config: EmbeddingConfig | None = None) -> None:
        super().__init__()
        self.config = config or EmbeddingConfig()
        self.width = self.config.width

    def bind(self, deformation: DeformationModel, canonical: Gaussians) -> None:
        config = self.config
        parts = "field" in deformation.provides and config.tokens in (None, len(PART_NAMES))
        averages = None
        if parts:
            assert isinstance(deformation, ProvidesField)
            averages = part_averages(deformation.field_parts()).to(canonical.means)
        self.register_buffer("averages", averages, persistent=False)
        count = config.tokens or (len(PART_NAMES) if parts else len(canonical))
        times = () if config.keyframes is None else (config.keyframes,)
        shape = (count, *times, config.width)
        self.embedding = nn.Parameter(0.1 * torch.randn(shape).to(canonical.means))
        if parts:
            self.tokens = "part"
        elif config.tokens is None:
            self.tokens, self.per_gaussian = "gaussian", ("embedding",)

    @torch.no_grad()
    def _positions(
        self, deformation: DeformationModel, canonical: Gaussians, moment: Moment
    ) -> Float[Tensor, "M 3"]:
        if self.averages is not None:
            assert isinstance(deformation, ProvidesField)
            return self.averages @ deformation.posed_field(canonical, moment)[1]
        means = deformation(canonical, moment).means
        return means if self.per_gaussian else means.mean(0).expand(len(self.embedding), 3)

    def forward(
        self, deformation: DeformationModel, canonical: Gaussians, moment: Moment
    ) -> Tokens:
        features: Tensor = self.embedding
        if self.config.keyframes is not None:
            features = linear(features, keyframe_position(moment.time, self.config.keyframes))
        return Tokens(features, self._positions(deformation, canonical, moment))
