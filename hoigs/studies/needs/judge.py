"""Whether anybody would see what a model has lost: PSNR of a few frames, region by region."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.clip import Clip
from hoigs.core.errors import HoigsError
from hoigs.core.rasterizer import RenderRequest
from hoigs.core.scene import SceneModel
from hoigs.evaluation.metrics import psnr_from_mse
from hoigs.evaluation.regions import default_band, region_masks
from hoigs.studies.needs.halving import SCORING, Ledger

WATCHED = ("human_object", "background")


@dataclass(frozen=True)
class Look:
    """Mean PSNR, dB, over the frames that show a region; by region, at least one."""

    psnr: Mapping[str, float]

    def drop_to(self, other: Look) -> float:
        """How much worse `other` is, dB, in the region where that is most."""
        return max(self.psnr[region] - other.psnr[region] for region in self.psnr)


@dataclass
class Judge:
    """Looks at models; each look is paid for.

    Args:
        clip: at training width. positions: of the frames. ledger: in steps of a full training.
    """

    clip: Clip
    positions: Sequence[int]
    ledger: Ledger

    @property
    def price(self) -> float:
        return SCORING * len(self.positions)

    @property
    def affordable(self) -> bool:
        return self.ledger.left >= self.price

    @torch.no_grad()
    def look(self, model: SceneModel, subset: Bool[Tensor, " N"] | None = None) -> Look:
        """Draw every frame and score it.

        Args:
            subset: rows of the joined Gaussians to draw; None draws all.

        Raises:
            HoigsError: no frame shows any region. BudgetError: it cannot be paid.
        """
        self.ledger.spend("look", self.price)
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
                f"frames {list(self.positions)} show neither people, things nor background: "
                "nothing can be judged by them"
            )
        return Look({region: mean(found) for region, found in values.items()})


def _squares(color: Tensor, target: Tensor) -> Float[Tensor, "H W"]:
    """Squared error of each pixel, mean over RGB."""
    return (color.cpu().clamp(0, 1) - target).square().mean(-1)
