"""features:spline-motion: a token for each Gaussian of an object (HOIGS, "Feature Extraction")."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.deformation import DeformationModel, ProvidesVelocity
from hoigs.core.features import FeatureExtractor, Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.core.spline import catmull_rom

Embedding = Literal["per-gaussian", "shared", "low-rank"]


class SplineMotionConfig(ComponentConfig):
    """The paper's object features.

    Attributes:
        width: of the tokens; the main text has 32, the supplement 33 (methods A.5).
        embedding: "per-gaussian" keeps e_k for each Gaussian and keyframe, 29 N K floats, which
            is 73 % of a keyframed object (N = 20 000, K = 75: 174 MB, four times that with Adam);
            "shared" one e_k for all, 29 K; "low-rank" `rank` shared ones mixed by N * rank.
        embedding_width: of e. hidden: of the MLP.
        keyframes: of the embedding; None takes the deformation's.
    """

    width: int = Field(32, ge=1)
    embedding: Embedding = "per-gaussian"
    embedding_width: int = Field(29, ge=1)
    rank: int = Field(4, ge=1)
    hidden: int = Field(64, ge=1)
    keyframes: int | None = Field(None, ge=2)


class SplineMotionFeatures(FeatureExtractor):
    """f_o(t) = MLP([tau(t); e(t); t]), at each Gaussian's centre.

    tau(t) is the exact derivative of the position spline, e(t) a cubic Hermite spline through the
    learnable e_k with Catmull-Rom tangents ("interpolated by CHS"; the paper gives e no tangents).
    Positions carry no gradient.
    """

    requires = frozenset({"velocity"})
    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding", "mixture": "embedding"}

    def __init__(
        self,
        width: int = 32,
        embedding: Embedding = "per-gaussian",
        embedding_width: int = 29,
        rank: int = 4,
        hidden: int = 64,
        keyframes: int | None = None,
    ) -> None:
        super().__init__()
        self.width, self.kind, self.rank = width, embedding, rank
        self.embedding_width, self.keyframes = embedding_width, keyframes
        self.mlp = nn.Sequential(
            nn.Linear(3 + embedding_width + 1, hidden), nn.ReLU(), nn.Linear(hidden, width)
        )
        self.per_gaussian = {
            "per-gaussian": ("embedding",),
            "shared": (),
            "low-rank": ("mixture",),
        }[embedding]

    def bind(self, deformation: DeformationModel, rest: Gaussians) -> None:
        keyframes = self.keyframes or getattr(deformation, "keyframes", None)
        if not isinstance(keyframes, int):
            raise ValueError(
                f"{type(deformation).__name__} has no keyframes to take the embedding's from; set "
                "`keyframes` of features:spline-motion"
            )
        rows = {"per-gaussian": len(rest), "shared": 1, "low-rank": self.rank}[self.kind]
        shape = (rows, keyframes, self.embedding_width)
        self.embedding = nn.Parameter(0.1 * torch.randn(shape).to(rest.means))
        if self.kind == "low-rank":
            self.mixture = nn.Parameter(torch.randn(len(rest), self.rank).to(rest.means))

    def embedded(self, count: int, time: float) -> Float[Tensor, "N E"]:
        """e(t) of each of `count` Gaussians."""
        codes = catmull_rom(self.embedding, time)
        if self.kind == "low-rank":
            return self.mixture @ codes / self.rank**0.5
        return codes.expand(count, -1)

    def forward(self, deformation: DeformationModel, rest: Gaussians, moment: Moment) -> Tokens:
        assert isinstance(deformation, ProvidesVelocity)
        velocity = deformation.velocity(rest, moment)
        code = self.embedded(len(rest), moment.time)
        clock = velocity.new_full((len(rest), 1), moment.time)
        features = self.mlp(torch.cat((velocity, code, clock), dim=-1))
        with torch.no_grad():
            positions = deformation(rest, moment).means
        return Tokens(features, positions)
