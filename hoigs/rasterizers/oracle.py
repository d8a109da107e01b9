"""The reference that other backends are tested against: float64, every splat at every pixel."""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.rasterizer import (
    OPTICS,
    Capabilities,
    Rasterizer,
    RenderOutput,
    RenderRequest,
)
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.compositing import blend, prepare, to_output


class OracleConfig(ComponentConfig):
    """Settings of OracleRasterizer."""

    cutoffs: bool = Field(default=False, description="obey min_alpha and min_transmittance")
    """True obeys `min_alpha` and `min_transmittance`, as the other backends do. False takes them as
    0, so that the picture is a smooth function of the input but for depth order, `near` and
    `max_alpha`."""


class OracleRasterizer(Rasterizer):
    """Draws exactly by the rules of `hoigs.core.maths.projection`, in float64, in O(pixels N) time.

    Input of float32 is converted; the output is float64, and gradients come back in the input's
    dtype. Memory is bounded for every size.
    """

    Config: ClassVar = OracleConfig
    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32", "float64"}),
        camera_gradients=True,
        deterministic=True,
        absolute_gradients=True,
        optics=OPTICS,
    )

    def __init__(self, config: OracleConfig | None = None) -> None:
        self.config = config or OracleConfig()

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw in float64; see `Rasterizer.render`."""
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        if not self.config.cutoffs:
            request = request.replace(min_alpha=0.0, min_transmittance=0.0)
        gaussians, camera = gaussians.map(lambda x: x.double()), camera.to(torch.float64)
        splats, info = prepare(gaussians, camera, request)
        pixels = camera.pixel_grid().flatten(0, 1)
        return to_output(blend(pixels, splats, request), camera, request, info)
