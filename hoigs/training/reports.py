"""What training reports of itself: logged steps, and PSNR of previews."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.clip import Clip, Frame
from hoigs.metrics.psnr import psnr, region_psnr


@dataclass(frozen=True)
class StepReport:
    """One logged step: a line of `metrics.jsonl`, and the argument of `on_step`.

    Attributes:
        time_s: of training since the run began, previews aside. loss: the weighted sum.
        losses: unweighted terms. counts: Gaussians by entity. psnr: of previews by split, dB.
    """

    step: int
    time_s: float
    loss: float
    losses: dict[str, float]
    counts: dict[str, int]
    psnr: dict[str, float] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        record = dict(vars(self))
        if not self.psnr:
            del record["psnr"]
        return record


@torch.no_grad()
def preview_scores(
    clip: Clip, draw: Callable[[Frame], Float[Tensor, "H W 3"]], frames: int = 4
) -> dict[str, float]:
    """PSNR of a few frames of each split, in dB, for the curves of the report.

    Args:
        draw: the picture of a frame, by the model as it is now.
    """
    scores = {}
    for split, positions in clip.split.items():
        stride = max(1, len(positions) // frames)
        values = []
        for position in list(positions)[::stride][:frames]:
            frame = clip[position]
            color = draw(frame).cpu().clamp(0, 1)
            if frame.ignored is None:
                values.append(float(psnr(color, frame.rgb)))
            elif not frame.ignored.all():
                values.append(float(region_psnr(color, frame.rgb, ~frame.ignored)))
        if values:
            scores[split] = sum(values) / len(values)
    return scores
