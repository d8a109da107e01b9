"""features:spline-motion: a token for each Gaussian of an object (HOIGS, "Feature Extraction")."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.clock import Time, filled
from hoigs.core.config import ComponentConfig
from hoigs.core.deformation import DeformationModel, ProvidesVelocity
from hoigs.core.features import FeatureExtractor, Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.core.spline import (
    catmull_rom,
    hermite_basis,
    keyframe_position,
    knot_pair,
    lerp,
    linear,
)

Embedding = Literal["per-gaussian", "shared", "low-rank", "none"]
Interpolation = Literal["catmull-rom", "zero-tangent", "linear"]
Velocity = Literal["derivative", "keyframes"]


class SplineMotionConfig(ComponentConfig):
    """The paper's object features.

    Attributes:
        width: of the tokens: 32 in the main text, the default; 33 in the supplement, which is the
            width of the MLP's input 3 + 29 + 1. Attention projects either to its own width.
        embedding: "per-gaussian", the default, keeps e_k for each Gaussian and keyframe, as the
            supplement says ("for each keyframe Gaussian"): 29 N K floats, which is 73 % of a
            keyframed object (N = 20 000, K = 75: 174 MB, four times that with Adam). "shared" is
            one e_k for all, 29 K, as the main text may be read; "low-rank" mixes `rank` shared
            ones by N * rank weights; "none" leaves e out: tokens know velocity and time alone.
        interpolation: of e. "Interpolated by CHS" needs tangents, which e has none of; by
            default "catmull-rom" finite differences, smooth and free of parameters; or
            "zero-tangent", or "linear".
        velocity: tau(t). "derivative", the default, is the exact derivative of the position
            spline; "keyframes" interpolates the learned tangents tau_k as e is, as the words say:
            it equals the derivative at the keyframes alone, and needs learned tangents of every
            Gaussian at keyframes that stay.
        embedding_width: of e. rank: how many codes "low-rank" mixes. hidden: of the MLP.
        keyframes: of the embedding; None takes the deformation's.
    """

    width: int = Field(32, ge=1)
    embedding: Embedding = "per-gaussian"
    interpolation: Interpolation = "catmull-rom"
    velocity: Velocity = "derivative"
    embedding_width: int = Field(29, ge=1)
    rank: int = Field(4, ge=1)
    hidden: int = Field(64, ge=1)
    keyframes: int | None = Field(None, ge=2)


class SplineMotionFeatures(FeatureExtractor):
    """f_o(t) = MLP([tau(t); e(t); t]), at each Gaussian's centre.

    Without an embedding f_o(t) = MLP([tau(t); t]). t is in [0, 1], tau in metres per keyframe
    interval. For readings of tau(t) and e(t) see SplineMotionConfig. Positions carry no gradient.
    """

    requires = frozenset({"velocity"})
    recordable = True
    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding", "mixture": "embedding"}

    def __init__(
        self,
        width: int = 32,
        embedding: Embedding = "per-gaussian",
        interpolation: Interpolation = "catmull-rom",
        velocity: Velocity = "derivative",
        embedding_width: int = 29,
        rank: int = 4,
        hidden: int = 64,
        keyframes: int | None = None,
    ) -> None:
        super().__init__()
        self.width, self.kind, self.rank = width, embedding, rank
        self.embedding_width, self.keyframes = embedding_width, keyframes
        self.interpolation, self.tau = interpolation, velocity
        inputs = 4 if embedding == "none" else 3 + embedding_width + 1
        self.mlp = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, width))
        self.per_gaussian = {
            "per-gaussian": ("embedding",),
            "shared": (),
            "low-rank": ("mixture",),
            "none": (),
        }[embedding]

    def bind(self, deformation: DeformationModel, rest: Gaussians) -> None:
        if self.tau == "keyframes":
            tangents = getattr(deformation, "tangents", None)
            movable = getattr(getattr(deformation, "knots", None), "movable", False)
            each = isinstance(tangents, Tensor) and tangents.shape[:-2] == (len(rest),)
            if movable or not each:
                raise ValueError(
                    f"{type(deformation).__name__} has no learned tangents tau_k for each Gaussian "
                    "at keyframes that stay; set `velocity: derivative` of features:spline-motion"
                )
        if self.kind == "none":
            return
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

    def embedded(self, count: int, time: Time) -> Float[Tensor, "N E"]:
        """e(t) of each of `count` Gaussians."""
        codes = self._between(self.embedding, time)
        if self.kind == "low-rank":
            return self.mixture @ codes / self.rank**0.5
        return codes.expand(count, -1)

    def _between(self, values: Float[Tensor, "N K D"], time: Time) -> Float[Tensor, "N D"]:
        """Values of the keyframes at `time`."""
        if self.interpolation == "linear":
            return linear(values, time)
        if self.interpolation == "zero-tangent":
            k, r = keyframe_position(time, values.shape[1])
            return lerp(*knot_pair(values, k), hermite_basis(r)[2])
        return catmull_rom(values, time)

    def _velocity(
        self, deformation: DeformationModel, rest: Gaussians, moment: Moment
    ) -> Float[Tensor, "N 3"]:
        """tau(t)."""
        if self.tau == "keyframes":
            tangents = deformation.tangents
            assert isinstance(tangents, Tensor)
            return self._between(tangents, moment.time)
        assert isinstance(deformation, ProvidesVelocity)
        return deformation.velocity(rest, moment)

    def forward(self, deformation: DeformationModel, rest: Gaussians, moment: Moment) -> Tokens:
        velocity = self._velocity(deformation, rest, moment)
        known = [velocity, filled(velocity, (len(rest), 1), moment.time)]
        if self.kind != "none":
            known.insert(1, self.embedded(len(rest), moment.time))
        features = self.mlp(torch.cat(known, dim=-1))
        with torch.no_grad():
            positions = deformation.means_at(rest, moment)
        return Tokens(features, positions)
