"""What the motions over keyframes of the clip have in common: their settings, knots and start."""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel, HasKnots, StepStatistics
from hoigs.core.maths import splines
from hoigs.core.maths.splines import Knots
from hoigs.core.model.knot_refit import KnotTrial, ScreenMotion, cameras_of_frames, remove_knots
from hoigs.core.parameters import Resizing, on_host
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import AxisChange
from hoigs.plugins.deformation.irradiance import Irradiance, outward_normals, turned_normals
from hoigs.plugins.deformation.rigid_track import RigidTrack

# Adaptive keyframes: training inserts knots where the image loss is largest and removes knots that
# the motion on the screen does not need.


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


LARGE_STEP = math.radians(120)
REFIT_SMOOTHNESS = 1e-8  # so faint that it decides only what the samples leave open


class KeyframedConfig(ComponentConfig):
    """Keyframes of a motion."""

    keyframes: Annotated[int, Field(ge=2)] | Literal["adaptive"] | None = None
    """Number of knots; None derives it from `keyframe_step` and the clip's length; "adaptive"
    starts from that, with at least `adaptive.minimum`, and lets training insert and remove
    knots."""
    keyframe_step: int = Field(default=4, ge=1)
    """Frames between knots (the paper's 4)."""
    tangents: Literal["learned", "finite-difference"] = "learned"
    """"learned" velocities at the knots (the paper), or "finite-difference" of its neighbours."""
    track: bool = True
    """Start from the object's rigid track, where it has one, else at rest."""
    light: bool = False
    """Learn the light by the direction in which the surface faces (`Irradiance`), so that colours
    change as the object turns; False is the paper."""
    adaptive: AdaptiveKnotsConfig = Field(default_factory=AdaptiveKnotsConfig)
    """When and how knots change, if `keyframes` is "adaptive"."""


class Keyframed(Resizing, DeformationModel):
    """Base of motions over K knots (`HasKnots`).

    With `light`, `normals` [N, 3] are a parameter, those of the canonical Gaussians' surface.

    Args:
        config: with `keyframes` None or "adaptive", K follows from the number of frames.
        num_frames: frames of the clip; by default those of the track.
        track: the canonical Gaussians are then those of the object about its centre, and the
            motion starts from the track.
        cameras: camera of every frame, if `keyframes` is "adaptive".

    Raises:
        ValueError: neither `keyframes` nor frames to derive them; adaptive without cameras.
    """

    Config: ClassVar = KeyframedConfig
    provides = frozenset({"velocity"})

    knot_axes: Mapping[str, int]
    normals: nn.Parameter

    def __init__(
        self,
        config: KeyframedConfig | None = None,
        *,
        num_frames: int | None = None,
        track: ObjectTrack | None = None,
        cameras: Sequence[Camera] = (),
    ) -> None:
        super().__init__()
        self.config = config = config or self.Config()
        if num_frames is None and track is not None:
            num_frames = len(track.rotations)
        adaptive, keyframes = config.keyframes == "adaptive", config.keyframes
        if not isinstance(keyframes, int):
            if num_frames is None:
                raise ValueError(
                    f"{type(self).__name__} needs `keyframes`, or `num_frames` or a `track` to "
                    "derive them"
                )
            keyframes = splines.keyframe_count(num_frames, config.keyframe_step)
        if adaptive:
            keyframes = max(keyframes, config.adaptive.minimum)
        self.knots = Knots(keyframes, movable=adaptive)
        self.schedule = KnotSchedule(cameras, config.adaptive) if adaptive else None
        self.keyframes = keyframes  # at the start: features take the size of their own from it
        self.learned = config.tangents == "learned"
        self.num_frames = num_frames
        self.input_space = "canonical" if track is not None else "world"
        self._track = track
        self.irradiance: Irradiance | None = None
        if config.light:
            self.irradiance = Irradiance()
            self.per_gaussian = (*self.per_gaussian, "normals")

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(config, **cls.given(config, context))

    @staticmethod
    def given(config: KeyframedConfig, context: BuildContext) -> dict[str, Any]:
        """The constructor's arguments that come from the context."""
        clip = context.clip
        return {
            "num_frames": None if clip is None else clip.num_frames,
            "track": context.object_track if config.track else None,
            "cameras": cameras_of_frames(clip) if clip and config.keyframes == "adaptive" else (),
        }

    def starting_track(self, like: Tensor) -> RigidTrack | None:
        """The track that the motion starts from; warns of turns too large for the keyframes."""
        if self._track is None:
            return None
        track = RigidTrack(self._track).to(like)
        step = track.largest_step(self.keyframes)
        if step > LARGE_STEP:
            warnings.warn(
                f"the object turns {math.degrees(step):.0f} degrees between two keyframes: slerp "
                "may turn it the wrong way, and splines of points cut such corners; use more "
                "keyframes (a smaller keyframe_step)",
                stacklevel=4,
            )
        return track

    def bind_light(self, canonical: Gaussians) -> None:
        """To be called by `bind`."""
        if self.irradiance is not None:
            self.irradiance.to(canonical.means)
            self.normals = nn.Parameter(outward_normals(canonical.detach()))

    def lit(self, moved: Gaussians, canonical: Gaussians) -> Gaussians:
        """Gaussians that were turned from their canonical rotations, in the light there."""
        if self.irradiance is None:
            return moved
        normals = self.normals / self.normals.norm(dim=-1, keepdim=True)  # they start with length 1
        return self.irradiance(moved, turned_normals(normals, canonical.quats, moved.quats))

    def refitted(
        self, samples: Float[Tensor, "S D"], fit: Sequence[float], times: Sequence[float]
    ) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
        """Values and tangents at knots at `times`, fitted to samples of the motion at `fit`."""
        knots = self.knots.placed(times)
        return knots.fit(samples, fit, free_tangents=self.learned, smoothness=REFIT_SMOOTHNESS)

    def knot_penalties(
        self, values: Float[Tensor, "N K 3"], tangents: Float[Tensor, "N K 3"] | None
    ) -> dict[str, Tensor]:
        """Squared, mean per curve and knot, in metres per interval. "acceleration": second
        differences of uniform knots. "tangent": learned tangents against finite differences, which
        an interval's few frames cannot determine alone."""
        penalties: dict[str, Tensor] = {}
        if len(self.knots) > 2 and not self.knots.movable:
            penalties["acceleration"] = splines.accelerations(values).square().sum(-1).mean()
        if tangents is not None:
            apart = tangents - self.knots.differences(values)
            penalties["tangent"] = apart.square().sum(-1).mean()
        return penalties

    @abstractmethod
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        """As `HasKnots`."""

    @abstractmethod
    def traced(self, canonical: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        """As `HasKnots`."""

    def evolve(self, canonical: Gaussians, statistics: StepStatistics) -> Mapping[str, AxisChange]:
        return {} if self.schedule is None else self.schedule.step(self, canonical, statistics)
