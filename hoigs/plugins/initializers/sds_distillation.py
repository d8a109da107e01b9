"""Gaussians from a diffusion model and one view: DreamGaussian's first stage.

DreamGaussian (Tang et al. 2024, sec. 3.1), which DreamScene4D's static stage derives from and
HOIGS names as its object initializer. Left out: densification; the count stays.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import NotFiniteError
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderRequest
from hoigs.core.model.object_placement import mask_box
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import FIELDS, Gaussians

# Score distillation: the gradient of an image towards what a diffusion model expects.
#
# DreamFusion (Poole et al. 2023, eq. 3). With latents x, alpha_bar a of a noise step t, noise eps
# and the model's guess eps_hat of it in x_t = sqrt(a) x + sqrt(1 - a) eps,
#
# grad_x L = w(t) (eps_hat(x_t, t, condition) - eps),    w(t) = 1 - a.

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
            views: camera offsets from the reference view: elevation (downwards) and azimuth (to
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


RATES = {"quats": 5e-3, "log_scales": 5e-3, "opacity_logits": 0.05, "sh": 0.01}
FIRST_RATE, LAST_RATE = 1e-3, 2e-5  # of the means, falling exponentially
MARGIN = 0.2  # of the reference image is empty about the object


class DistillationConfig(ComponentConfig):
    """How Gaussians are distilled; defaults are DreamGaussian's and DreamScene4D's."""

    steps: int = Field(default=500, ge=1, description="optimizer steps")
    count: int = Field(default=5_000, ge=4, description="number of Gaussians")
    batch: int = Field(default=1, ge=1, description="random views a step; DreamScene4D: 16")
    radius: float = Field(
        default=2.0, gt=0.6, description="radius of the orbit of views, canonical units"
    )
    fov_degrees: float = Field(
        default=49.1, gt=0, lt=120, description="vertical field of view of every view"
    )
    elevation_degrees: float = Field(
        default=0.0, ge=-80, le=80, description="elevation of the reference camera above the object"
    )
    reach_degrees: float = Field(
        default=30.0, gt=0, le=80, description="views reach at least this elevation up and down"
    )
    sds_weight: float = Field(default=1.0, ge=0, description="weight of the diffusion model's loss")
    image_weight: float = Field(
        default=10_000.0, ge=0, description="weight of the reference view's RGB loss"
    )
    mask_weight: float = Field(
        default=1_000.0, ge=0, description="weight of the reference view's alpha loss"
    )
    min_opacity: float = Field(
        default=0.05, gt=0, lt=1, description="fainter Gaussians are removed at the end"
    )


@dataclass(frozen=True)
class Reference:
    """The view that is known.

    Attributes:
        image: RGB in [0, 1] on white. mask: share of the object.
    """

    image: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W"]


def reference_view(clip: Clip, entity: str, at: int, size: int) -> Reference:
    """The object of one frame, cut out, centred and on white.

    Raises:
        ValueError: it is not seen in that frame.
    """
    frame = clip[at]
    box = mask_box(frame.masks[entity])
    if box is None:
        raise ValueError(f"the mask of {entity} is empty in frame {at}; give another `reference`")
    left, top, right, bottom = box
    side = max(right - left, bottom - top) / (1 - MARGIN)
    steps = (torch.arange(size) + 0.5) / size - 0.5
    x = (left + right) / 2 + side * steps
    y = (top + bottom) / 2 + side * steps
    height, width = frame.masks[entity].shape
    grid = torch.stack(torch.meshgrid(2 * x / width - 1, 2 * y / height - 1, indexing="xy"), -1)
    both = torch.cat((frame.rgb, frame.masks[entity].float()[..., None]), -1).permute(2, 0, 1)
    cut = torch.nn.functional.grid_sample(both[None], grid[None], align_corners=False)[0]
    image, mask = cut[:3].permute(1, 2, 0), cut[3]
    return Reference(image * mask[..., None] + 1 - mask[..., None], mask)


def orbit_camera(view: Float[Tensor, " 3"], settings: DistillationConfig, size: int) -> Camera:
    """A camera that looks at the origin, about which -y is up.

    Args:
        view: from the reference view: elevation downwards and azimuth to the right, radians, and
            added distance.
    """
    down, right, farther = view.tolist()
    down -= math.radians(settings.elevation_degrees)
    level = math.cos(down)
    way = torch.tensor((math.sin(right) * level, math.sin(down), -math.cos(right) * level))
    return Camera.look_at(
        (settings.radius + farther) * way,
        torch.zeros(3),
        width=size,
        height=size,
        fov_y=math.radians(settings.fov_degrees),
        up=(0.0, -1.0, 0.0),
    )


def distil(
    denoiser: Denoiser,
    rasterizer: Rasterizer,
    reference: Reference | None,
    settings: DistillationConfig | None = None,
    *,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Gaussians:
    """Gaussians about the origin, of about unit size, in axes of which -y is up.

    Axes are OpenCV's of the reference camera if that is level; else see `orbit_camera`.

    Every step adds the known view's loss, if there is one, to the distillation loss of random
    views; noise steps anneal from noisy to clean.
    """
    settings = settings or DistillationConfig()
    generator = torch.Generator(device).manual_seed(seed)
    chance = torch.Generator().manual_seed(seed)  # on the CPU: views are the same on any device
    shape = {k: getattr(_ball(settings.count, chance), k).to(device) for k in FIELDS}
    shape = {k: v.requires_grad_() for k, v in shape.items()}
    rates = {"means": FIRST_RATE, **RATES}
    optimizer = torch.optim.Adam(
        [{"params": [v], "lr": rates[k], "name": k} for k, v in shape.items()], eps=1e-15
    )
    for step in range(1, settings.steps + 1):
        ratio = step / settings.steps
        optimizer.param_groups[0]["lr"] = FIRST_RATE * (LAST_RATE / FIRST_RATE) ** ratio
        gaussians = Gaussians(**shape)
        loss = torch.zeros((), device=device)
        if reference is not None:
            loss = loss + ratio * _known_view(gaussians, rasterizer, reference, settings)
        if settings.sds_weight:
            images, views = _random_views(gaussians, rasterizer, denoiser, settings, ratio, chance)
            noise_step = annealed_step(ratio, len(denoiser.alphas))
            loss = loss + settings.sds_weight * distillation_loss(
                denoiser, images, views, noise_step, generator
            )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    made = Gaussians(**shape).detach()
    made.check_finite("distilled Gaussians")
    return made[made.opacities >= settings.min_opacity]


def _ball(count: int, chance: torch.Generator) -> Gaussians:
    """Grey Gaussians, evenly within a ball of radius 0.5."""
    ways = torch.nn.functional.normalize(torch.randn(count, 3, generator=chance), dim=1)
    depth = torch.rand(count, 1, generator=chance) ** (1 / 3)
    return Gaussians.from_points(0.5 * depth * ways, opacity=0.1)


def _draw(
    gaussians: Gaussians, rasterizer: Rasterizer, camera: Camera, background: float
) -> tuple[Float[Tensor, "3 H W"], Float[Tensor, "H W"]]:
    device = gaussians.means.device
    request = RenderRequest(background=torch.full((3,), background, device=device))
    output = rasterizer.render(gaussians, camera.to(device), request)
    return output.color.permute(2, 0, 1), output.alpha


def _known_view(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    reference: Reference,
    settings: DistillationConfig,
) -> Float[Tensor, ""]:
    camera = orbit_camera(torch.zeros(3), settings, len(reference.mask))
    color, alpha = _draw(gaussians, rasterizer, camera, 1.0)
    image = reference.image.permute(2, 0, 1).to(color)
    return (
        settings.image_weight * (color - image).square().mean()
        + settings.mask_weight * (alpha - reference.mask.to(alpha)).square().mean()
    )


def _random_views(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    denoiser: Denoiser,
    settings: DistillationConfig,
    ratio: float,
    chance: torch.Generator,
) -> tuple[Float[Tensor, "B 3 H W"], Float[Tensor, "B 3"]]:
    """Images from anywhere on the orbit, at the denoiser's size, and where from."""
    above, reach = settings.elevation_degrees, settings.reach_degrees
    low = max(min(-reach, above - reach), above - 80)  # never nearer than 10 degrees to a pole
    high = min(max(reach, above + reach), above + 80)
    first, last = torch.tensor([[low, -180.0], [high, 180.0]]).deg2rad()
    draws = first + (last - first) * torch.rand(settings.batch, 2, generator=chance)
    views = torch.nn.functional.pad(draws, (0, 1))
    size = min(denoiser.size, 128 if ratio < 0.3 else 256 if ratio < 0.6 else 512)
    images = []
    for view in views:
        white = denoiser.white or bool(torch.rand((), generator=chance) < 0.5)
        camera = orbit_camera(view, settings, size)
        images.append(_draw(gaussians, rasterizer, camera, float(white))[0])
    batch = torch.nn.functional.interpolate(
        torch.stack(images), (denoiser.size, denoiser.size), mode="bilinear", align_corners=False
    )
    return batch, views.to(batch.device)
