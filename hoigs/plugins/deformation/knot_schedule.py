"""Adaptive keyframes: knots go in where the picture is worst and out where nobody would notice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Literal, Protocol

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.camera import Camera
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import StepEvidence
from hoigs.core.gaussians import Gaussians
from hoigs.core.topology import AxisChange
from hoigs.plugins.deformation.knots import Knots
from hoigs.plugins.deformation.on_host import on_host

PROBES = 64  # Gaussians whose paths stand for all
NEAR = 0.05  # metres; what is nearer to the camera, or behind it, is not measured


class AdaptiveKnotsConfig(ComponentConfig):
    """When and how knots change (methods G.3).

    Attributes:
        begin, end: fractions of the run between which rounds take place. every: steps between
            rounds. The last round only removes; with `begin` at `end` there is no other, which
            suits motions that begin with knots to spare (`keyframe_step`).
        insert_by: intervals get a knot by their mean image loss ("residual") or by how much the
            motion bends within them on the screen ("acceleration").
        share: of the intervals that get a knot in a round, the worst first; at least one.
        pixels: a knot goes when the spline refitted without it stays this close. The measure is
            the mean over the object in the worst frame: SplineGS's mean over all frames would let
            a long quiet clip hide one jerk.
        minimum, maximum: number of knots. spacing: frames between knots at least, give or take a
            quarter: uniform knots "every four frames" of 64 are 3.94 apart, and may be halved.
    """

    begin: float = Field(0.2, ge=0, le=1)
    end: float = Field(0.7, ge=0, le=1)
    every: int = Field(100, ge=1)
    insert_by: Literal["residual", "acceleration"] = "residual"
    share: float = Field(0.25, gt=0, le=1)
    pixels: float = Field(1.0, gt=0)
    minimum: int = Field(4, ge=4)
    maximum: int = Field(64, ge=4)
    spacing: int = Field(2, ge=1)


class MovingCurve(Protocol):
    """What a deformation with movable knots offers."""

    knots: Knots
    knot_axes: Mapping[str, int]  # parameter name to the axis along which its knots lie

    def get_parameter(self, target: str) -> nn.Parameter: ...

    def modules(self) -> Iterator[nn.Module]: ...

    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        """Parameters of this same motion with knots at `times`; fitted to the present motion at
        the times `fit`, or, where there are none, read off it (exact when only adding knots)."""
        ...

    def traced(self, rest: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        """World positions of some Gaussians at some times, metres."""
        ...


def probe_rows(count: int) -> Tensor:
    """Rows of at most PROBES Gaussians, spread evenly."""
    return torch.linspace(0, count - 1, min(count, PROBES)).round().long()


class KnotSchedule(nn.Module):
    """Decides about knots; remembers the image loss of each frame.

    Args:
        cameras: one a frame, at the size that pixels are counted in.
        config: as AdaptiveKnotsConfig.

    Raises:
        ValueError: without cameras, against which pixels could be measured.
    """

    error_sum: Tensor
    error_count: Tensor
    intrinsics: Tensor
    world_to_camera: Tensor

    def __init__(self, cameras: Sequence[Camera], config: AdaptiveKnotsConfig | None = None):
        super().__init__()
        if not cameras:
            raise ValueError("adaptive keyframes need the clip's cameras, one a frame")
        self.config = config or AdaptiveKnotsConfig()
        frames = len(cameras)
        self.frame_times = [f / max(frames - 1, 1) for f in range(frames)]
        self.register_buffer("error_sum", torch.zeros(frames))
        self.register_buffer("error_count", torch.zeros(frames))
        for name, tensors in {
            "intrinsics": [c.K for c in cameras],
            "world_to_camera": [c.world_to_camera for c in cameras],
        }.items():
            self.register_buffer(name, torch.stack(tensors).float(), persistent=False)

    @staticmethod
    def from_context(config: AdaptiveKnotsConfig, context: BuildContext) -> KnotSchedule:
        if context.clip is None:
            raise ValueError('keyframes: "adaptive" needs a clip, whose cameras measure pixels')
        by_index = dict(zip((m.index for m in context.clip.moments), context.clip.cameras,
                            strict=True))  # fmt: skip
        last, cameras = min(by_index), []
        for index in range(context.clip.num_frames):
            last = index if index in by_index else last
            cameras.append(by_index[last])
        return KnotSchedule(cameras, config)

    def observe(self, evidence: StepEvidence) -> None:
        """Count one frame's image loss."""
        last = len(self.frame_times) - 1
        frame = min(max(round(evidence.moment.time * last), 0), last)
        self.error_sum[frame] += evidence.error
        self.error_count[frame] += 1

    def due(self, step: int, total_steps: int) -> Literal["", "both", "removal"]:
        """Whether knots may change after this step: "both" ways, or in the last round only out."""
        first, last = (round(f * total_steps) for f in (self.config.begin, self.config.end))
        if step < max(first, 1) or step > last or (step - first) % self.config.every != 0:
            return ""
        return "both" if step + self.config.every <= last else "removal"

    @torch.no_grad()
    def step(
        self, curve: MovingCurve, rest: Gaussians, evidence: StepEvidence
    ) -> dict[str, AxisChange]:
        """To be called after every step; what the optimizer has to follow, if anything."""
        self.observe(evidence)
        due = self.due(evidence.step, evidence.total_steps)
        if not due:
            return {}
        before = curve.knots.tolist()
        with on_host(curve), on_host(self):
            near = rest.to("cpu")
            self.remove(curve, near)
            if due == "both":
                self.insert(curve, near)
        self.error_sum.zero_()
        self.error_count.zero_()
        after = curve.knots.tolist()
        if after == before:
            return {}
        places = {time: k for k, time in enumerate(before)}
        device = rest.means.device
        source = torch.tensor([places.get(time, -1) for time in after], device=device)
        return {
            name: AxisChange(axis, source, source < 0) for name, axis in curve.knot_axes.items()
        }

    def remove(self, curve: MovingCurve, rest: Gaussians) -> None:
        """Take out knots, the least missed first, as long as the refitted motion stays within
        `pixels` of what it was before the first went (SplineGS, with a stricter measure)."""
        still = self.screen(curve, rest)
        fit = self.sample_times()
        while len(curve.knots) > self.config.minimum:
            times = curve.knots.tolist()
            trials = []
            for k in range(1, len(times) - 1):
                with KnotTrial(curve) as trial:
                    trial.leave_out(k)
                    trials.append((self.deviation(still, self.screen(curve, rest)), k))
            for _, k in sorted(trials)[:3]:  # the refit is dear, so only the likeliest have one
                with KnotTrial(curve) as trial:
                    trial.place(times[:k] + times[k + 1 :], fit)
                    if self.deviation(still, self.screen(curve, rest)) <= self.config.pixels:
                        trial.keep()
                        break
            else:
                return

    def insert(self, curve: MovingCurve, rest: Gaussians) -> None:
        """Halve the intervals that need it most; the motion stays as it is."""
        times = curve.knots.tolist()
        scores = self._scores(curve, rest, times)
        frame = 1 / max(len(self.frame_times) - 1, 1)
        wide = [
            k
            for k in range(len(times) - 1)
            if scores[k] > 0 and times[k + 1] - times[k] > (2 * self.config.spacing - 0.5) * frame
        ]
        room = self.config.maximum - len(times)
        count = min(max(1, round(self.config.share * (len(times) - 1))), room, len(wide))
        if count <= 0:
            return
        chosen = sorted(wide, key=lambda k: (-scores[k], k))[:count]
        added = times + [(times[k] + times[k + 1]) / 2 for k in chosen]
        with KnotTrial(curve) as trial:
            trial.place(sorted(added), ())
            trial.keep()

    def _scores(self, curve: MovingCurve, rest: Gaussians, times: list[float]) -> list[float]:
        """How much each interval needs a knot."""
        if self.config.insert_by == "acceleration":
            screen = self.screen(curve, rest)
            bends = torch.zeros(len(self.frame_times))
            if len(screen) > 2:
                second = screen[2:] - 2 * screen[1:-1] + screen[:-2]
                bends[1:-1] = second.norm(dim=-1).nan_to_num(0.0).mean(1).cpu()
            weight = torch.ones_like(bends)
        else:
            bends, weight = self.error_sum.cpu(), self.error_count.cpu()
        frames, scores = torch.tensor(self.frame_times, dtype=torch.float64), []
        for start, end in pairwise(times):
            inside = (frames >= start - 1e-9) & (frames <= end + 1e-9)
            score = float(bends[inside].sum() / weight[inside].sum().clamp_min(1e-12))
            if self.config.insert_by == "acceleration":
                score *= (end - start) ** 2  # what a cubic misses grows with its length
            scores.append(score)
        return scores

    def sample_times(self) -> list[float]:
        """Every frame and every half frame."""
        count = 2 * (len(self.frame_times) - 1)
        return [i / count for i in range(count + 1)] if count > 0 else [0.0, 1.0]

    def screen(self, curve: MovingCurve, rest: Gaussians) -> Float[Tensor, "F P 2"]:
        """Pixels at which the probes stand in every frame; NaN where they are not in front."""
        return self.on_screen(curve.traced(rest, self.frame_times))

    def on_screen(self, points: Float[Tensor, "F P 3"]) -> Float[Tensor, "F P 2"]:
        """Pixels of world points, a row a frame; NaN where they are not in front."""
        points = points.float()
        turn, shift = self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3]
        camera = points @ turn.mT + shift[:, None]
        pixels = camera @ self.intrinsics.mT
        return torch.where(camera[..., 2:] > NEAR, pixels[..., :2] / pixels[..., 2:], torch.nan)

    @staticmethod
    def deviation(a: Float[Tensor, "F P 2"], b: Float[Tensor, "F P 2"]) -> float:
        """Mean distance over the probes in the worst frame, pixels."""
        mean = (a - b).norm(dim=-1).nanmean(1)
        return float(mean.nan_to_num(0.0).max())


class KnotTrial:
    """Other knots for a curve, undone on leaving unless kept."""

    def __init__(self, curve: MovingCurve) -> None:
        self.curve, self.kept = curve, False
        self.times = curve.knots.tolist()
        self.values = {name: curve.get_parameter(name).data for name in curve.knot_axes}

    def __enter__(self) -> KnotTrial:
        return self

    def place(self, times: Sequence[float], fit: Sequence[float]) -> None:
        values = self.curve.resampled(times, fit)
        self.curve.knots.place(times)
        self._set(values)

    def leave_out(self, k: int) -> None:
        """One knot fewer; the others as they are."""
        self.curve.knots.place(self.times[:k] + self.times[k + 1 :])
        values = {}
        for name, value in self.values.items():
            axis = self.curve.knot_axes[name]
            after = value.narrow(axis, k + 1, value.shape[axis] - k - 1)
            values[name] = torch.cat((value.narrow(axis, 0, k), after), axis)
        self._set(values)

    def keep(self) -> None:
        self.kept = True

    def __exit__(self, *error: object) -> None:
        if not self.kept:
            self.curve.knots.place(self.times)
            self._set(self.values)

    def _set(self, values: Mapping[str, Tensor]) -> None:
        for name, value in values.items():
            parameter = self.curve.get_parameter(name)
            parameter.grad = None
            parameter.data = value.contiguous()
