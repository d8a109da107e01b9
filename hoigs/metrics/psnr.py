"""PSNR of whole images and of regions. Images are RGB in [0, 1] with channels last."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.metrics.inputs import check_pair, check_region

MSE_FLOOR = 1e-10  # two equal images score 100 dB rather than infinity


def psnr(
    image: Float[Tensor, "*batch H W C"], target: Float[Tensor, "*batch H W C"]
) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio, dB, for a peak of 1.

    Of a batch it is the mean of the PSNR of each image, not the PSNR of the mean error, as in 3DGS.
    The mean squared error is floored at 1e-10 (100 dB).
    """
    check_pair(image, target)
    return psnr_from_mse((image - target).square().mean((-3, -2, -1))).mean()


def region_psnr(
    image: Float[Tensor, "H W C"], target: Float[Tensor, "H W C"], region: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """PSNR over the pixels of a region, dB: the error is divided by the region's area.

    Raises:
        ValueError: the region has no pixels.
    """
    check_pair(image, target)
    check_region(image, region)
    return psnr_from_mse((image - target)[region].square().mean())


def psnr_from_mse(mse: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """dB of a mean squared error, for a peak of 1."""
    return -10.0 * mse.clamp_min(MSE_FLOOR).log10()
