"""The image loss of 3D Gaussian Splatting: L1 and D-SSIM mixed."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from hoigs.metrics.ssim import Backend, ssim


def image_loss(
    render: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    lambda_dssim: float,
    backend: Backend = "torch",
) -> Float[Tensor, ""]:
    """(1 - lambda) L1 + lambda (1 - SSIM), means over the image (3DGS, Kerbl et al. 2023, Eq. 7).

    Args:
        backend: as for `ssim`, which is skipped where lambda is 0.
    """
    l1 = (render - target).abs().mean()
    if lambda_dssim == 0:
        return l1
    return (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim(render, target, backend))
