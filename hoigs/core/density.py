"""DensityControl: when and where an entity gains or loses Gaussians."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.gaussians import Gaussians
from hoigs.core.topology import TopologyChange

if TYPE_CHECKING:
    from hoigs.core.context import BuildContext


@dataclass
class DensityStatistics:
    """What is gathered for one entity between two refinements; all of shape [N].

    Attributes:
        gradient_sum: sum over visible views of the screen-space gradient norm, in units of half
            the image (3DGS's NDC convention).
        visible_count: number of views in which each Gaussian was drawn.
        max_radius: largest screen radius seen, pixels.
    """

    gradient_sum: Float[Tensor, " N"]
    visible_count: Float[Tensor, " N"]
    max_radius: Float[Tensor, " N"]

    @staticmethod
    def zeros(count: int, device: torch.device | str = "cpu") -> DensityStatistics:
        return DensityStatistics(*(torch.zeros(count, device=device) for _ in range(3)))

    def add(
        self,
        screen_gradient: Float[Tensor, "N 2"],
        radii: Float[Tensor, " N"],
        width: int,
        height: int,
    ) -> None:
        """Count one view. `screen_gradient` is in pixels, as `RenderRequest.screen_offsets`."""
        visible = radii > 0
        half = screen_gradient.new_tensor((width / 2, height / 2))
        norm = (screen_gradient * half).norm(dim=-1)
        self.gradient_sum += torch.where(visible, norm, torch.zeros_like(norm))
        self.visible_count += visible
        self.max_radius = torch.maximum(self.max_radius, radii.to(self.max_radius))

    @property
    def mean_gradient(self) -> Float[Tensor, " N"]:
        return self.gradient_sum / self.visible_count.clamp_min(1)


@dataclass(frozen=True)
class Refinement:
    """A decision: how rows follow, and the new rest values.

    Attributes:
        change: the index map. rest: the M new rest Gaussians. reset_opacity: cap on all
            opacities (activated) after this step, or None.
    """

    change: TopologyChange | None
    rest: Gaussians | None
    reset_opacity: float | None = None


class DensityControl(ABC):
    """A strategy for one entity. It decides; training applies, optimizer state included."""

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(**config.model_dump())

    @abstractmethod
    def refine(
        self,
        rest: Gaussians,
        current: Gaussians,
        statistics: DensityStatistics,
        *,
        step: int,
        total_steps: int,
        extent: float,
    ) -> Refinement | None:
        """Called after every step; None means nothing changes at this one.

        Args:
            rest: the entity's canonical Gaussians. current: the same at the last moment drawn.
            statistics: gathered since the last refinement that was not None.
            extent: scene extent, metres, guarded to be positive for static cameras.
        """
