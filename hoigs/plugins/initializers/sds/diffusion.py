"""Score distillation: the gradient of an image towards what a diffusion model expects.

DreamFusion (Poole et al. 2023, eq. 3). With latents x, alpha_bar a of a noise step t, noise eps
and the model's guess eps_hat of it in x_t = sqrt(a) x + sqrt(1 - a) eps,

    grad_x L = w(t) (eps_hat(x_t, t, condition) - eps),    w(t) = 1 - a.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import NotFiniteError

STEP_RANGE = (0.02, 0.98)  # of all noise steps: the ends give no useful gradient (DreamFusion)


class Denoiser(ABC):
    """A diffusion model with its condition.

    Attributes:
        size: pixels of the square images that it takes.
        alphas: alpha_bar by noise step, falling from nearly 1 to nearly 0.
        white: whether it expects a white background; else any will do.
    """

    size: int
    alphas: Float[Tensor, " T"]
    white: bool = True

    @abstractmethod
    def encode(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """Latents of RGB images in [0, 1], differentiable."""

    @abstractmethod
    def predict(
        self, noisy: Float[Tensor, "B C h w"], step: int, views: Float[Tensor, "B 3"]
    ) -> Float[Tensor, "B C h w"]:
        """The noise in noisy latents, guidance included.

        Args:
            views: of the camera, from the reference view: elevation (downwards) and azimuth (to
                the right), radians, and what is added to its distance.
        """


def annealed_step(ratio: float, steps: int) -> int:
    """Noise step at a share of the training: from noisy to clean (DreamGaussian, sec. 3.1)."""
    low, high = (round(share * steps) for share in STEP_RANGE)
    return min(max(round((1 - ratio) * steps), low), high)


def distillation_loss(
    denoiser: Denoiser,
    images: Float[Tensor, "B 3 H W"],
    views: Float[Tensor, "B 3"],
    step: int,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """A loss whose gradient by the latents is w(t) (eps_hat - eps) / B.

    Raises:
        NotFiniteError: the model gave NaN or infinity.
    """
    latents = denoiser.encode(images)
    alpha = denoiser.alphas[step].to(latents)
    with torch.no_grad():
        noise = torch.randn(latents.shape, generator=generator, device=generator.device)
        noise = noise.to(latents)
        noisy = alpha.sqrt() * latents + (1 - alpha).sqrt() * noise
        gradient = (1 - alpha) * (denoiser.predict(noisy, step, views) - noise)
        if not bool(torch.isfinite(gradient).all()):
            raise NotFiniteError(
                f"the diffusion model gave NaN or infinity at noise step {step}; with half: true, "
                "try half: false"
            )
        target = latents - gradient
    return 0.5 * (latents - target).square().sum() / len(images)
