"""Validator: PSNR of a few frames by region, to measure what pruning costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.metrics.psnr import psnr_from_mse
from hoigs.metrics.regions import default_band, region_masks
from hoigs.studies.needs.successive_halving import SCORING, StepBudget

WATCHED = ("human_object", "background")


@dataclass(frozen=True)
class Scores:
    """Mean PSNR, dB, over the frames that show a region; by region, at least one."""

    psnr: Mapping[str, float]

    def drop_to(self, other: Scores) -> float:
        """How much worse `other` is, dB, in the region where that is most."""
        return max(self.psnr[region] - other.psnr[region] for region in self.psnr)


@dataclass
class Validator:
    """Scores models on validation frames; each scoring is entered in a budget.

    Args:
        clip: at training width. positions: of the frames. budget: in steps of the full spec.
    """

    clip: Clip
    positions: Sequence[int]
    budget: StepBudget

    @property
    def cost(self) -> float:
        """Of one scoring, in steps of the full spec."""
        return SCORING * len(self.positions)

    @property
    def affordable(self) -> bool:
        return self.budget.left >= self.cost

    @torch.no_grad()
    def score(self, model: SceneModel, subset: Bool[Tensor, " N"] | None = None) -> Scores:
        """Render every frame and score it.

        Args:
            subset: rows of the joined Gaussians to render; None renders all.

        Raises:
            HoigsError: no frame shows any region. BudgetError: it exceeds the budget.
        """
        self.budget.spend("scoring", self.cost)
        values: dict[str, list[float]] = {}
        for position in self.positions:
            frame = self.clip[position]
            output = model.render(
                frame.moment.to(model.device),
                frame.camera.to(model.device),
                request=RenderRequest(subset=subset),
            )
            squares = _squares(output.color, frame.rgb)
            masks = region_masks(
                frame, self.clip.kinds, default_band(frame.camera.width, frame.camera.height)
            )
            for region in WATCHED:
                if masks[region].any():
                    error = squares[masks[region]].mean()
                    values.setdefault(region, []).append(float(psnr_from_mse(error)))
        if not values:
            raise HoigsError(
                f"frames {list(self.positions)} show neither people, objects nor background: "
                "the model cannot be scored on them"
            )
        return Scores({region: mean(found) for region, found in values.items()})


def _squares(color: Tensor, target: Tensor) -> Float[Tensor, "H W"]:
    """Squared error of each pixel, mean over RGB."""
    return (color.cpu().clamp(0, 1) - target).square().mean(-1)
