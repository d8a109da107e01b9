"""The truth that other backends are tested against: float64, every splat at every pixel."""

from __future__ import annotations

import torch
from pydantic import Field

from hoigs.core.camera import Camera
from hoigs.core.config import ComponentConfig
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Capabilities, Rasterizer, RenderOutput, RenderRequest
from hoigs.rasterizers.compositing import blend, prepare, to_output


class OracleConfig(ComponentConfig):
    cutoffs: bool = Field(False, description="obey min_alpha and min_transmittance")


class OracleRasterizer(Rasterizer):
    """Draws by the letter of `hoigs.core.projection`, in float64, in O(pixels N) time.

    Input of float32 is converted; the output is float64, and gradients come back in the input's
    dtype. Memory is bounded, so that any size can be drawn by who can wait.

    Args:
        cutoffs: False takes `min_alpha` and `min_transmittance` as 0, which makes the picture a
            smooth function of the input but for depth order, `near` and `max_alpha`; True obeys
            them, as the other backends do.
    """

    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32", "float64"}),
        camera_gradients=True,
        deterministic=True,
        absolute_gradients=True,
    )

    def __init__(self, cutoffs: bool = False) -> None:
        self.cutoffs = cutoffs

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw in float64; see `Rasterizer.render`."""
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        if not self.cutoffs:
            request = request.replace(min_alpha=0.0, min_transmittance=0.0)
        gaussians, camera = gaussians.map(lambda x: x.double()), camera.to(torch.float64)
        splats, info = prepare(gaussians, camera, request)
        pixels = camera.pixel_grid().flatten(0, 1)
        return to_output(blend(pixels, splats, request), camera, request, info)
