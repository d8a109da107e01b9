"""Renders as 8-bit pictures: colour, false-colour depth and error, entities with alpha."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import Moment

ERROR_FULL = 0.25  # absolute error, of colours in [0, 1], that is drawn white


DEPTH_DARKEST = 0.1  # of depth's colour map: what is darker is left for transparent pixels


@torch.no_grad()
def draw(
    model: SceneModel, moment: Moment, camera: Camera, only: Iterable[str] | None = None
) -> RenderOutput:
    """Render one view on the model's device, without gradients."""
    return model.render(moment.to(model.device), camera.to(model.device), only=only)


def picture(color: Float[Tensor, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
    """Values clamped to [0, 1] and rounded to 8 bits."""
    array: np.ndarray = (color.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return array


def cut_out(output: RenderOutput) -> UInt8[np.ndarray, "H W 4"]:
    """A render as RGBA, with straight (not premultiplied) alpha."""
    alpha = output.alpha.clamp(0, 1)[..., None]
    straight = output.color / alpha.clamp_min(1e-3)
    return np.concatenate((picture(straight), picture(alpha)), -1)


def error_picture(
    color: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute error of the channels in false colour, from black (0) to white (ERROR_FULL)."""
    error = (color.clamp(0, 1) - target.to(color)).abs().mean(-1)
    return false_color(error / ERROR_FULL, "inferno")


def depth_range(output: RenderOutput) -> tuple[float, float]:
    """Percentiles 2 and 98 of the depth where the view is opaque, metres."""
    seen = output.expected_depth[output.alpha > 0.5]
    if len(seen) == 0:
        return 0.0, 1.0
    near, far = torch.quantile(seen[:: max(1, len(seen) // 100_000)], seen.new_tensor([0.02, 0.98]))
    return float(near), max(float(far), float(near) + 1e-3)


def depth_picture(output: RenderOutput, span: tuple[float, float]) -> UInt8[np.ndarray, "H W 3"]:
    """Depth in false colour, near is bright, darkened by transparency."""
    near, far = span
    closeness = (far - output.expected_depth) / (far - near)
    bright = DEPTH_DARKEST + (1 - DEPTH_DARKEST) * closeness.clamp(0, 1)
    shown = false_color(bright, "magma").astype(np.float32)
    return (shown * output.alpha.clamp(0, 1)[..., None].cpu().numpy()).round().astype(np.uint8)


def error_colors(count: int = 9) -> list[str]:
    """The colours of errors from 0 to ERROR_FULL, as #rrggbb."""
    return _hex(torch.linspace(0, 1, count), "inferno")


def depth_colors(count: int = 9) -> list[str]:
    """The colours of depths from near to far, as #rrggbb."""
    return _hex(torch.linspace(1, DEPTH_DARKEST, count), "magma")


def _hex(values: Float[Tensor, " N"], name: str) -> list[str]:
    return [f"#{bytes(color).hex()}" for color in false_color(values[None], name)[0]]


def false_color(values: Float[Tensor, "H W"], name: str) -> UInt8[np.ndarray, "H W 3"]:
    """Values in [0, 1], clamped, by one of matplotlib's maps."""
    import matplotlib

    mapped = matplotlib.colormaps[name](values.clamp(0, 1).cpu().numpy(), bytes=True)
    return np.ascontiguousarray(mapped[..., :3])
