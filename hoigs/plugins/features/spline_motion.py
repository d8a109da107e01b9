"""features:spline-motion: one token for each Gaussian of an object (HOIGS, Eq. 8)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.device import Time, filled
from hoigs.core.interfaces.deformation import DeformationModel, ProvidesVelocity
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.maths.splines import (
    Interval,
    Knots,
    catmull_rom,
    hermite_weights,
    keyframe_position,
    knot_pair,
    lerp,
    linear,
)
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Tokens


class SplineMotionConfig(ComponentConfig):
    """The paper's object features."""

    width: int = Field(default=32, ge=1)
    """Width of the tokens: 32 in the main text, the default; 33 in the supplement, which is the
    width of the MLP's input 3 + 29 + 1. Attention projects either to its own width."""
    embedding: Literal["per-gaussian", "shared", "low-rank", "none"] = "per-gaussian"
    """"per-gaussian", the default, keeps e_k for each Gaussian and keyframe, as the supplement has
    it ("for each keyframe Gaussian"): 29 N K floats, which is 73 % of a keyframed object (N = 20
    000, K = 75: 174 MB, four times that with Adam). "shared" is one e_k for all, 29 K floats, as
    the main text may be read; "low-rank" mixes `rank` shared ones with N * rank weights; "none"
    leaves e out: f_o(t) = MLP([tau(t); t])."""
    interpolation: Literal["catmull-rom", "zero-tangent", "linear"] = "catmull-rom"
    """Interpolation of e. "Interpolated by CHS" needs tangents, which e does not have:
    "catmull-rom", the default, takes finite differences, smooth and without parameters;
    "zero-tangent"; or "linear"."""
    velocity: Literal["derivative", "keyframes"] = "derivative"
    """The velocity tau(t). "derivative", the default, is the exact derivative of the position
    spline; "keyframes" interpolates the learned tangents tau_k as e is, as the paper writes: it
    equals the derivative only at the keyframes, and needs learned tangents of every Gaussian at
    fixed keyframes."""
    embedding_width: int = Field(default=29, ge=1)
    """Width of e."""
    rank: int = Field(default=4, ge=1)
    """Number of codes that "low-rank" mixes."""
    hidden: int = Field(default=64, ge=1)
    """Width of the MLP's hidden layer."""
    keyframes: int | None = Field(default=None, ge=2)
    """Number of keyframes of the embedding; None takes the deformation's."""


class SplineMotionFeatures(FeatureExtractor):
    """f_o(t) = MLP([tau(t); e(t); t]), at the mean of each Gaussian (HOIGS, Eq. 8).

    t is in [0, 1], tau in metres per keyframe interval. Positions have no gradient.
    """

    Config: ClassVar = SplineMotionConfig
    requires = frozenset({"velocity"})
    tokens = "gaussian"
    cuda_graph_safe = True
    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding", "mixture": "embedding"}

    def __init__(self, config: SplineMotionConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SplineMotionConfig()
        self.width = config.width
        inputs = 4 if config.embedding == "none" else 3 + config.embedding_width + 1
        self.mlp = nn.Sequential(
            nn.Linear(inputs, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.width)
        )
        names = {"per-gaussian": ("embedding",), "low-rank": ("mixture",)}
        self.per_gaussian = names.get(config.embedding, ())

    def bind(self, deformation: DeformationModel, canonical: Gaussians) -> None:
        config = self.config
        if config.velocity == "keyframes":
            tangents = getattr(deformation, "tangents", None)
            movable = getattr(getattr(deformation, "knots", None), "movable", False)
            each = isinstance(tangents, Tensor) and tangents.shape[:-2] == (len(canonical),)
            if movable or not each:
                raise ValueError(
                    f"{type(deformation).__name__} has no learned tangents tau_k for each Gaussian "
                    "at fixed keyframes; set `velocity: derivative` of features:spline-motion"
                )
        if config.embedding == "none":
            return
        keyframes = config.keyframes or getattr(deformation, "keyframes", None)
        if not isinstance(keyframes, int):
            raise ValueError(
                f"{type(deformation).__name__} has no keyframes that the embedding could take; "
                "set `keyframes` of features:spline-motion"
            )
        counts = {"per-gaussian": len(canonical), "shared": 1, "low-rank": config.rank}
        shape = (counts[config.embedding], keyframes, config.embedding_width)
        self.embedding = nn.Parameter(0.1 * torch.randn(shape).to(canonical.means))
        self.knots = Knots(keyframes).to(canonical.means.device)
        self.time_rows = {"embedding": self.knots.rows}
        if config.embedding == "low-rank":
            mixture = torch.randn(len(canonical), config.rank).to(canonical.means)
            self.mixture = nn.Parameter(mixture)

    def embedded(self, count: int, time: Time) -> Float[Tensor, "N E"]:
        """e(t) of each of `count` Gaussians."""
        codes = self._between(self.embedding, self.knots.at(time))
        if self.config.embedding == "low-rank":
            return self.mixture @ codes / self.config.rank**0.5
        return codes.expand(count, -1)

    def _between(self, values: Float[Tensor, "N K D"], at: Interval) -> Float[Tensor, "N D"]:
        """Values of the keyframes, interpolated."""
        if self.config.interpolation == "linear":
            return linear(values, at)
        if self.config.interpolation == "zero-tangent":
            return lerp(*knot_pair(values, at.k), hermite_weights(at.r)[2])
        return catmull_rom(values, at)

    def _velocity(
        self, deformation: DeformationModel, canonical: Gaussians, moment: Moment
    ) -> Float[Tensor, "N 3"]:
        """tau(t)."""
        if self.config.velocity == "keyframes":
            tangents, knots = deformation.tangents, getattr(deformation, "knots", None)
            assert isinstance(tangents, Tensor)
            if isinstance(knots, Knots):
                return self._between(tangents, knots.at(moment.time))
            return self._between(tangents, keyframe_position(moment.time, tangents.shape[1]))
        assert isinstance(deformation, ProvidesVelocity)
        return deformation.velocity(canonical, moment)

    def forward(
        self, deformation: DeformationModel, canonical: Gaussians, moment: Moment
    ) -> Tokens:
        velocity = self._velocity(deformation, canonical, moment)
        inputs = [velocity, filled(velocity, (len(canonical), 1), moment.time)]
        if self.config.embedding != "none":
            inputs.insert(1, self.embedded(len(canonical), moment.time))
        features = self.mlp(torch.cat(inputs, dim=-1))
        with torch.no_grad():
            positions = deformation.means_at(canonical, moment)
        return Tokens(features, positions)

    def with_fewer_knots(
        self, before: int, after: int
    ) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
        if self.config.velocity == "keyframes":
            return None  # these tokens are the tangents themselves
        weight = self.mlp.get_parameter("0.weight").detach().clone()
        weight[:, :3] *= (after - 1) / (before - 1)  # velocities are per interval, now longer
        settings = {"keyframes": self.config.keyframes or before}
        return {} if self.config.embedding == "none" else settings, {"mlp.0.weight": weight}
