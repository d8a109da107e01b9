"""DensityControl: which Gaussians of an entity are cloned, split, pruned or relocated, and when.

A DensityControl decides and returns a Refinement; `hoigs.training.density` applies it.
"""

from __future__ import annotations

import hashlib
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.device import constant
from hoigs.core.errors import RenderError, class_name
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange


@dataclass
class DensityStatistics:
    """Statistics of one entity between two refinements; all of shape [N].

    Attributes:
        gradient_sum: sum over visible views of the screen-space gradient norm, in units of half
            the image (3DGS's NDC convention).
        visible_count: number of views in which each Gaussian was drawn.
        max_radius: largest screen radius, pixels.
        absolute_sum: as `gradient_sum`, of the absolute gradient (`RenderRequest
            .absolute_gradients`); zero unless the controller declares `absolute_gradients`.
        loss_sum: sum over visible views of the view's loss.
    """

    gradient_sum: Float[Tensor, " N"]
    visible_count: Float[Tensor, " N"]
    max_radius: Float[Tensor, " N"]
    absolute_sum: Float[Tensor, " N"] = None  # type: ignore[assignment]  # zero if left out
    loss_sum: Float[Tensor, " N"] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.absolute_sum is None:
            self.absolute_sum = torch.zeros_like(self.gradient_sum)
        if self.loss_sum is None:
            self.loss_sum = torch.zeros_like(self.gradient_sum)

    @staticmethod
    def zeros(count: int, device: torch.device | str = "cpu") -> DensityStatistics:
        return DensityStatistics(*(torch.zeros(count, device=device) for _ in range(5)))

    def add(
        self,
        screen_gradient: Float[Tensor, "N 2"],
        radii: Float[Tensor, " N"],
        width: int,
        height: int,
        *,
        absolute_gradient: Float[Tensor, "N 2"] | None = None,
        loss: Float[Tensor, ""] | None = None,
    ) -> None:
        """Add one view.

        Args:
            screen_gradient: per pixel of displacement, as of `RenderRequest.screen_offsets`.
            radii: pixels, 0 where a Gaussian is not drawn. width, height: image size, pixels.
            absolute_gradient: see `RenderRequest.absolute_gradients`. loss: that of the view.
        """
        visible = radii > 0
        half = constant((width / 2, height / 2), screen_gradient)
        norm = (screen_gradient * half).norm(dim=-1)
        self.gradient_sum += torch.where(visible, norm, torch.zeros_like(norm))
        self.visible_count += visible
        self.max_radius = torch.maximum(self.max_radius, radii.to(self.max_radius))
        if absolute_gradient is not None:
            norm = (absolute_gradient * half).norm(dim=-1)
            self.absolute_sum += torch.where(visible, norm, torch.zeros_like(norm))
        if loss is not None:
            self.loss_sum += visible * loss.to(self.loss_sum)

    @property
    def mean_gradient(self) -> Float[Tensor, " N"]:
        return self.gradient_sum / self.visible_count.clamp_min(1)

    @property
    def mean_absolute_gradient(self) -> Float[Tensor, " N"]:
        return self.absolute_sum / self.visible_count.clamp_min(1)


@dataclass(frozen=True)
class Refinement:
    """A decision of density control.

    Attributes:
        change: the index map from old rows to new ones; None when rows stay.
        canonical: the M new canonical Gaussians; None when rows stay.
        reset_opacity: upper bound of all opacities (activated) after this step, or None.
    """

    change: TopologyChange | None
    canonical: Gaussians | None
    reset_opacity: float | None = None


class DensityControl(Configurable, ABC):
    """The strategy for one entity.

    It keeps no state from one step to the next (random numbers come from `step_generator`), so that
    a resumed run equals an uninterrupted one.

    Attributes:
        absolute_gradients: whether it needs absolute screen gradients, which not every rasterizer
            computes; see `check_rasterizer`.
        cap: largest count to which it grows; None declares no limit.
        keeps_all: whether it never changes anything, so that no statistics are kept for it.
        regularizer_weights: default weight of each penalty of `regularizers`; 0 where absent.
    """

    absolute_gradients: bool = False
    cap: int | None = None
    keeps_all: bool = False
    regularizer_weights: Mapping[str, float] = {}

    @abstractmethod
    def refine(
        self,
        canonical: Gaussians,
        current: Gaussians,
        statistics: DensityStatistics,
        *,
        step: int,
        total_steps: int,
        extent: float,
    ) -> Refinement | None:
        """Called after every step; None changes nothing.

        Args:
            canonical: the entity's canonical Gaussians, with the largest opacity that each has over
                time. current: its Gaussians at the last rendered moment.
            statistics: since the last refinement that was not None.
            extent: scene extent, metres; positive, also for static cameras.
        """

    def perturb(
        self, canonical: Gaussians, *, step: int, total_steps: int, rate: float
    ) -> Float[Tensor, "N 3"] | None:
        """Called after every step, after `refine`: offsets of the means, or None for none.

        Offsets are in canonical space, metres; a deformation that keeps positions of its own
        rotates them as it rotates the Gaussian. Optimizer moments stay.

        Args:
            canonical: as in `refine`. rate: current learning rate of the positions, metres a step;
                0 while they are frozen.
        """
        del canonical, step, total_steps, rate
        return None

    def regularizers(self, current: Gaussians) -> dict[str, Tensor]:
        """Named scalar penalties, unweighted, of the Gaussians at the rendered moment."""
        del current
        return {}


def check_rasterizer(control: DensityControl, rasterizer: Rasterizer | type[Rasterizer]) -> None:
    """Raise RenderError when `control` needs gradients that `rasterizer` does not compute."""
    if control.absolute_gradients and not rasterizer.capabilities.absolute_gradients:
        raise RenderError(
            f"{type(control).__name__} needs absolute screen gradients, which "
            f"{class_name(rasterizer)} does not compute; use rasterizer:warp, or density:adc, "
            "which does not need them"
        )


def step_generator(seed: int, step: int, device: torch.device, stream: int = 0) -> torch.Generator:
    """A generator for one step: the same in a resumed run, with no state to store.

    Args:
        stream: distinguishes several generators of the same step.
    """
    # hashed, because torch's CPU generator reads no more than the low 32 bits of a seed
    mixed = hashlib.blake2b(f"{seed} {step} {stream}".encode(), digest_size=4).digest()
    return torch.Generator(device=device).manual_seed(int.from_bytes(mixed, "big"))


def entity_seed(context: BuildContext) -> int:
    """A seed that differs between the entities of one run."""
    return (context.seed << 32) + zlib.crc32(context.entity.encode())
