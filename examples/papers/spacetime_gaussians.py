"""SpacetimeGaussians (Li et al., CVPR 2024, arXiv:2312.16812): motion, opacity and decoder.

    hoigs train builtin:juggle --plugin examples/papers/spacetime_gaussians.py \
        --spec examples/papers/spacetime-gaussians.yaml
"""

from __future__ import annotations

from typing import ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

import hoigs
from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.decoder import Decoder
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.values.tokens import Residual, displaced


class PolynomialConfig(ComponentConfig):
    degree: int = Field(default=3, ge=1)
    """n_p, of the positions; rotations are of degree 1, as in the paper."""
    width: float = Field(default=0.5, gt=0)
    """Standard deviation of the opacity over time at the start, as a share of the clip."""


class SpacetimePolynomial(hoigs.DeformationModel):
    """Each Gaussian has a time mu of its own, about which its motion is a polynomial.

    opacity   sigma exp(-s (t - mu)^2)                                          (Eq. 7)
    means     sum_k b_k (t - mu)^k, b_0 the canonical mean                      (Eq. 8)
    quats     c_0 + c_1 (t - mu), c_0 the canonical quaternion                  (Eq. 9)
    channels  [f_dir, (t - mu) f_time]; f_base is the colour                    (Eq. 10)
    """

    Config: ClassVar = PolynomialConfig
    per_gaussian = ("center", "log_sharpness", "motion", "spin", "view", "change")
    rates: ClassVar = {
        "center": "rotation", "log_sharpness": "opacity", "motion": "keyframes",
        "spin": "keyframe_rotation", "view": "embedding", "change": "embedding",
    }  # fmt: skip
    input_space = "world"

    def __init__(self, config: PolynomialConfig | None = None) -> None:
        super().__init__()
        self.config = config or PolynomialConfig()

    def bind(self, canonical: hoigs.Gaussians) -> None:
        new, count = canonical.means.new_zeros, len(canonical)
        # the first points belong to no time: their own are spread over the clip
        self.center = nn.Parameter(torch.linspace(0, 1, count).to(new(0))[torch.randperm(count)])
        sharpness = torch.full((count,), 0.5 / self.config.width**2).to(new(0))
        self.log_sharpness = nn.Parameter(sharpness.log())
        self.motion = nn.Parameter(new(count, self.config.degree, 3))  # b_1 to b_n, metres
        self.spin = nn.Parameter(new(count, 4))
        self.view = nn.Parameter(new(count, 3))
        self.change = nn.Parameter(new(count, 3))

    def forward(
        self,
        canonical: hoigs.Gaussians,
        moment: hoigs.Moment,
        residual: Residual | None = None,
    ) -> hoigs.Gaussians:
        since = (moment.time - self.center)[:, None]  # t - mu
        powers = torch.cat([since**k for k in range(1, self.config.degree + 1)], 1)
        means = canonical.means + (self.motion * powers[..., None]).sum(1)
        visible = self.log_sharpness.exp() * since.squeeze(1).square()
        log_opacity = (logsigmoid(canonical.opacity_logits) - visible).clamp(-20, -1e-6)
        return canonical.replace(
            means=displaced(means, residual),
            quats=canonical.quats + self.spin * since,
            opacity_logits=log_opacity - torch.log(-torch.expm1(log_opacity)),
            channels=torch.cat((self.view, self.change * since), 1),
        )


class FeatureDecoder(Decoder):
    """I = F_base + phi(F_dir, F_time, r), a two-layer MLP without bias (Eq. 11).

    r is the origin and the direction of the pixel's ray. phi is weighted by alpha, so that the
    background stays; the paper's background is black.
    """

    channels = 6

    def __init__(self) -> None:
        super().__init__()
        self.phi = nn.Sequential(
            nn.Linear(6 + 6, 6, bias=False), nn.ReLU(), nn.Linear(6, 3, bias=False)
        )

    def forward(
        self, drawn: RenderOutput, camera: hoigs.Camera, moment: hoigs.Moment
    ) -> Float[Tensor, "H W 3"]:
        rays = camera.rays()
        origin = camera.center.expand_as(rays)
        assert drawn.features is not None
        added = self.phi(torch.cat((drawn.features, origin, rays), -1))
        picture: Tensor = drawn.color + drawn.alpha[..., None] * added
        return picture


@hoigs.hookimpl
def hoigs_components():  # type: ignore[no-untyped-def]
    yield hoigs.Component(
        "deformation:spacetime-polynomial",
        f"{__name__}:SpacetimePolynomial",
        f"{__name__}:PolynomialConfig",
        summary="a polynomial in time for each Gaussian, about a time of its own",
    )
    yield hoigs.Component(
        "decoder:spacetime-features",
        f"{__name__}:FeatureDecoder",
        summary="colours and an MLP of features and rays",
    )
