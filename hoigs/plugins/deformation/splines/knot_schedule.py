"""Adaptive keyframes: training inserts knots where the image loss is largest and removes knots that
the motion on the screen does not need."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import HasKnots, StepStatistics
from hoigs.core.model.knot_refit import KnotTrial, ScreenMotion, remove_knots
from hoigs.core.model.on_host import on_host
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import AxisChange


class AdaptiveKnotsConfig(ComponentConfig):
    """When and how knots change."""

    begin: float = Field(default=0.2, ge=0, le=1)
    """Fraction of the run at which rounds begin."""
    end: float = Field(default=0.7, ge=0, le=1)
    """Fraction of the run at which rounds end."""
    every: int = Field(default=100, ge=1)
    """Steps between rounds. The last round only removes; with `begin` at `end` it is the only
    one, which suits motions that begin with more knots than they need (`keyframe_step`)."""
    insert_by: Literal["residual", "acceleration"] = "residual"
    """Intervals get a knot by their mean image loss ("residual") or by how much the motion bends
    within them on the screen ("acceleration")."""
    share: float = Field(default=0.25, gt=0, le=1)
    """Share of the intervals that get a knot in a round, the worst first; at least one."""
    pixels: float = Field(default=1.0, gt=0)
    """A knot is removed when the spline refitted without it stays this close, pixels: the mean over
    the object in the worst frame. SplineGS (Park et al. 2025) takes the mean over all frames, in
    which a long clip with little motion hides one jerk."""
    minimum: int = Field(default=4, ge=4)
    """Least number of knots."""
    maximum: int = Field(default=64, ge=4)
    """Largest number of knots."""
    spacing: int = Field(default=2, ge=1)
    """Least number of frames between knots, give or take a quarter: uniform knots "every four
    frames" of 64 are 3.94 apart, and may be halved."""


class KnotSchedule(nn.Module):
    """Inserts and removes knots in rounds; remembers the image loss of each frame between them.

    Args:
        cameras: as ScreenMotion.
    """

    error_sum: Tensor
    error_count: Tensor

    def __init__(self, cameras: Sequence[Camera], config: AdaptiveKnotsConfig | None = None):
        super().__init__()
        self.config, self.screen = config or AdaptiveKnotsConfig(), ScreenMotion(cameras)
        self.register_buffer("error_sum", torch.zeros(len(cameras)))
        self.register_buffer("error_count", torch.zeros(len(cameras)))

    def observe(self, statistics: StepStatistics) -> None:
        """Count one frame's image loss."""
        last = len(self.error_sum) - 1
        frame = min(max(round(statistics.moment.time * last), 0), last)
        self.error_sum[frame] += statistics.error
        self.error_count[frame] += 1

    def due(self, step: int, total_steps: int) -> Literal["", "both", "removal"]:
        """Whether knots may change after this step: "both" ways, or in the last round "removal"."""
        first, last = (round(f * total_steps) for f in (self.config.begin, self.config.end))
        if step < max(first, 1) or step > last or (step - first) % self.config.every != 0:
            return ""
        return "both" if step + self.config.every <= last else "removal"

    @torch.no_grad()
    def step(
        self, curve: HasKnots, canonical: Gaussians, statistics: StepStatistics
    ) -> dict[str, AxisChange]:
        """Called after every training step; returns what `DeformationModel.evolve` does."""
        self.observe(statistics)
        due = self.due(statistics.step, statistics.total_steps)
        if not due:
            return {}
        before = curve.knots.tolist()
        with on_host(curve), on_host(self):
            near = canonical.to("cpu")
            self.remove(curve, near)
            if due == "both":
                self.insert(curve, near)
        self.error_sum.zero_()
        self.error_count.zero_()
        after = curve.knots.tolist()
        if after == before:
            return {}
        places = {time: k for k, time in enumerate(before)}
        device = canonical.means.device
        source = torch.tensor([places.get(time, -1) for time in after], device=device)
        return {
            name: AxisChange(axis, source, source < 0) for name, axis in curve.knot_axes.items()
        }

    def remove(self, curve: HasKnots, canonical: Gaussians) -> None:
        """`remove_knots` by this schedule's settings."""
        pixels, minimum = self.config.pixels, self.config.minimum
        remove_knots(curve, canonical, self.screen, pixels=pixels, minimum=minimum)

    def insert(self, curve: HasKnots, canonical: Gaussians) -> None:
        """Halve the intervals that need it most; the motion stays as it is."""
        times = curve.knots.tolist()
        scores = self._scores(curve, canonical, times)
        frame = 1 / max(len(self.error_sum) - 1, 1)
        wide = [
            k
            for k in range(len(times) - 1)
            if scores[k] > 0 and times[k + 1] - times[k] > (2 * self.config.spacing - 0.5) * frame
        ]
        allowed = self.config.maximum - len(times)
        count = min(max(1, round(self.config.share * (len(times) - 1))), allowed, len(wide))
        if count <= 0:
            return
        chosen = sorted(wide, key=lambda k: (-scores[k], k))[:count]
        added = times + [(times[k] + times[k + 1]) / 2 for k in chosen]
        with KnotTrial(curve) as trial:
            trial.place(sorted(added), ())
            trial.keep()

    def _scores(self, curve: HasKnots, canonical: Gaussians, times: list[float]) -> list[float]:
        """How much each interval needs a knot."""
        bending = self.config.insert_by == "acceleration"
        if bending:
            paths = self.screen.paths(curve, canonical)
            values = torch.zeros(len(paths))
            if len(paths) > 2:
                second = paths[2:] - 2 * paths[1:-1] + paths[:-2]
                values[1:-1] = second.norm(dim=-1).nan_to_num(0.0).mean(1).cpu()
            weights = torch.ones_like(values)
        else:
            values, weights = self.error_sum.cpu(), self.error_count.cpu()
        frames, scores = torch.tensor(self.screen.frame_times, dtype=torch.float64), []
        for start, end in pairwise(times):
            inside = (frames >= start - 1e-9) & (frames <= end + 1e-9)
            score = float(values[inside].sum() / weights[inside].sum().clamp_min(1e-12))
            # a cubic's error grows with the length of its interval
            scores.append(score * (end - start) ** 2 if bending else score)
        return scores
