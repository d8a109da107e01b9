"""deformation:rigid-spline: one SE(3) spline moves a whole object (methods A.3, G.5)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core import spline
from hoigs.core.clip import ObjectTrack
from hoigs.core.clock import Time
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel, StepEvidence
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import multiply_quats, normalize_quats, quats_to_matrices, slerp
from hoigs.core.topology import AxisChange
from hoigs.plugins.deformation.knot_schedule import AdaptiveKnotsConfig, KnotSchedule, probe_rows
from hoigs.plugins.deformation.knots import Knots, Spans, Times, one_time
from hoigs.plugins.deformation.quaternion_spline import (
    angular_differences,
    hermite_factors,
    hermite_quats,
    turn_between,
)
from hoigs.plugins.deformation.resizing import Resizing
from hoigs.plugins.deformation.rigid_track import RigidTrack
from hoigs.plugins.deformation.track_guide import TrackGuide

Tangents = Literal["learned", "finite-difference"]
RotationCurve = Literal["cubic", "slerp"]

LARGE_STEP = math.radians(120)


class RigidSplineConfig(ComponentConfig):
    """One rigid motion for all Gaussians of an object.

    Attributes:
        keyframes: number of knots; None derives it from `keyframe_step` and the clip's length;
            "adaptive" starts from that and lets training insert and remove knots.
        keyframe_step: frames between knots.
        tangents: "learned" velocities at the knots, or "finite-difference" of neighbouring knots.
        rotation: "cubic", smooth, or "slerp", at constant speed between knots.
        track: start from the object's rigid track, where it has one, else at rest.
        adaptive: when and how knots change, if `keyframes` is "adaptive".
    """

    keyframes: int | Literal["adaptive"] | None = None
    keyframe_step: int = Field(4, ge=1)
    tangents: Tangents = "learned"
    rotation: RotationCurve = "cubic"
    track: bool = True
    adaptive: AdaptiveKnotsConfig = Field(default_factory=AdaptiveKnotsConfig)


class RigidSpline(Resizing, DeformationModel):
    """x(t) = R(t) (p - c) + c + T(t): every Gaussian moves with the object, and turns with it.

    T is a cubic Hermite spline, R a slerp or the cubic curve of `hermite_quats`; c is zero for an
    object with a track, else the centre of its Gaussians. Shapes, colours and places p in the
    object's frame are the rest Gaussians', trained as ever (keep SH degree 0 on an object that
    turns: higher bands do not turn with it). Times outside [0, 1] are held at the ends.

    Parameters, for K knots: `keyframe_translations` and `translation_tangents` [K, 3], metres;
    `keyframe_quats` [K, 4]; `angular_tangents` [K, 3], radians, in the object's frame. Tangents
    and `velocity` are per keyframe interval of the K knots that it starts with.

    Args:
        keyframes: K; or None with `num_frames` or a `track`, for one every `keyframe_step` frames.
        num_frames: frames of the clip; by default those of the track.
        track: rest is then the canonical object, and the splines start as those nearest to it.
        schedule: lets knots come and go in training (at least 4); None keeps them.
    """

    provides = frozenset({"velocity"})
    recordable = True
    rates: ClassVar[Mapping[str, str]] = {
        "keyframe_translations": "keyframes",
        "translation_tangents": "keyframes",
        "keyframe_quats": "keyframe_rotation",
        "angular_tangents": "keyframe_rotation",
    }
    resizes: ClassVar[Mapping[str, int]] = dict.fromkeys(rates, 0)
    # "tangent" a hundredth of chs's: here all Gaussians together speak for each
    regularizer_weights: ClassVar[Mapping[str, float]] = {"tangent": 1e-4, "track": 30.0}

    center: Tensor
    keyframe_translations: nn.Parameter
    translation_tangents: nn.Parameter
    keyframe_quats: nn.Parameter
    angular_tangents: nn.Parameter

    def __init__(
        self,
        keyframes: int | None = None,
        *,
        keyframe_step: int = 4,
        num_frames: int | None = None,
        tangents: Tangents = "learned",
        rotation: RotationCurve = "cubic",
        track: ObjectTrack | None = None,
        schedule: KnotSchedule | None = None,
    ) -> None:
        super().__init__()
        if keyframes is None:
            if num_frames is None and track is None:
                raise ValueError(
                    f"{type(self).__name__} needs `keyframes`, or `num_frames` or a `track` to "
                    "derive them"
                )
            frames = num_frames if num_frames is not None else len(track.rotations)  # type: ignore[union-attr]
            keyframes = spline.keyframe_count(frames, keyframe_step)
        if schedule is not None:
            keyframes = max(keyframes, schedule.config.minimum)
        self.knots = Knots(keyframes, movable=schedule is not None)
        self.schedule = schedule
        self.keyframes = keyframes  # at the start: features take the size of their own from it
        self.learned, self.smooth = tangents == "learned", rotation == "cubic"
        names = ["keyframe_translations", "keyframe_quats"]
        names += ["translation_tangents"] if self.learned else []
        names += ["angular_tangents"] if self.learned and self.smooth else []
        self.knot_axes: Mapping[str, int] = dict.fromkeys(names, 0)
        self.rest_space = "canonical" if track is not None else "world"
        self.guide = TrackGuide(track) if track is not None else None
        self._track = track

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(**cls._arguments(config, context))

    @staticmethod
    def _arguments(config: RigidSplineConfig, context: BuildContext) -> dict[str, Any]:
        """Constructor arguments of the motion."""
        adaptive = config.keyframes == "adaptive"
        return {
            "keyframes": None if adaptive else config.keyframes,
            "keyframe_step": config.keyframe_step,
            "num_frames": context.clip.num_frames if context.clip is not None else None,
            "tangents": config.tangents,
            "rotation": config.rotation,
            "track": context.object_track if config.track else None,
            "schedule": (KnotSchedule.from_context(config.adaptive, context) if adaptive else None),
        }

    def bind(self, rest: Gaussians) -> None:
        means = rest.means.detach()
        values = self._initial(means)
        for name in self.knot_axes:
            setattr(self, name, nn.Parameter(values[name].to(means).contiguous()))
        center = torch.zeros(3) if self._track is not None or len(means) == 0 else means.mean(0)
        self.register_buffer("center", center.to(means).clone())
        self._track = None

    def _initial(self, means: Tensor) -> dict[str, Tensor]:
        """Parameters at rest, or of the splines nearest to the track."""
        count = len(self.knots)
        if self._track is None:
            still = means.new_zeros(count, 3)
            quats = means.new_tensor((1.0, 0.0, 0.0, 0.0)).repeat(count, 1)
            return {
                "keyframe_translations": still,
                "translation_tangents": still.clone(),
                "keyframe_quats": quats,
                "angular_tangents": still.clone(),
            }
        track = RigidTrack(self._track).to(means)
        if track.largest_step(count) > LARGE_STEP:
            warnings.warn(
                f"the object turns {math.degrees(track.largest_step(count)):.0f} degrees between "
                "two keyframes, and may be turned the wrong way; use more keyframes (a smaller "
                "keyframe_step)",
                stacklevel=3,
            )
        places, velocities, quats, turns = track.rigid_knots(count, free_tangents=self.learned)
        if not (self.smooth and self.learned):  # knots alone: on the track, not near it
            quats = torch.stack([track.at(k / (count - 1))[0] for k in range(count)])
        return {
            "keyframe_translations": places,
            "translation_tangents": velocities,
            "keyframe_quats": quats,
            "angular_tangents": turns,
        }

    def poses(
        self, times: Times
    ) -> tuple[
        Float[Tensor, "T 4"], Float[Tensor, "T 3"], Float[Tensor, "T 3"], Float[Tensor, "T 3"]
    ]:
        """Rotations (wxyz), translations, and their velocities per keyframe interval: the angular
        ones in the object's frame, radians, the linear ones in the world, metres."""
        spans, tangents = self._spans(times), self._tangents()
        places = self.knots.hermite_in(spans, self.keyframe_translations, tangents)
        speeds = self.knots.hermite_in(spans, self.keyframe_translations, tangents, derivative=True)
        k, r, h = spans
        a, b = self.keyframe_quats[k], self.keyframe_quats[k + 1]
        if not self.smooth:
            return slerp(a, b, r), places, turn_between(a, b) / h, speeds
        velocities = self._velocities()
        quats, turning = hermite_quats(a, b, velocities[k], velocities[k + 1], r, h)
        return quats, places, turning, speeds

    def placed(self, times: Times) -> tuple[Float[Tensor, "T 4"], Float[Tensor, "T 3"]]:
        """Rotations and translations of `poses`, without what they cost to differentiate."""
        spans = self._spans(times)
        places = self.knots.hermite_in(spans, self.keyframe_translations, self._tangents())
        k, r, h = spans
        a, b = self.keyframe_quats[k], self.keyframe_quats[k + 1]
        if not self.smooth:
            return slerp(a, b, r), places
        velocities = self._velocities()
        return hermite_factors(a, b, velocities[k], velocities[k + 1], r, h)[0], places

    def _spans(self, times: Times) -> Spans:
        return self.knots.spans(times, self.keyframe_translations)

    def _tangents(self) -> Float[Tensor, "K 3"]:
        if self.learned:
            return self.translation_tangents
        return self.knots.differences(self.keyframe_translations[None])[0]

    def _velocities(self) -> Float[Tensor, "K 3"]:
        return self.angular_tangents if self.learned else self._angular_differences()

    def pose(
        self, time: Time
    ) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"], Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        """`poses` at one time."""
        quats, places, turning, speeds = self.poses(one_time(time))
        return quats[0], places[0], turning[0], speeds[0]

    def _angular_differences(self) -> Float[Tensor, "K 3"]:
        lengths = self.knots.times.to(self.keyframe_quats).diff() / self.knots.reference
        return angular_differences(self.keyframe_quats, lengths)

    def shape(
        self, rest: Gaussians, time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        """Centres and rotations in the object's frame; here they stay."""
        del time
        return rest.means, rest.quats

    def shape_velocity(self, rest: Gaussians, time: Time) -> Float[Tensor, "N 3"] | None:
        """Derivative of `shape`'s centres per keyframe interval; None while they stay."""
        del rest, time
        return None

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means, quats = self.shape(rest, moment.time)
        (quat,), (place,) = self.placed(one_time(moment.time))
        means = (means - self.center) @ quats_to_matrices(quat).mT + (self.center + place)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        turned = multiply_quats(quat.expand_as(quats), normalize_quats(quats))
        return replace(rest, means=means, quats=turned)

    def velocity(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """Exact time derivative of the means, metres per keyframe interval."""
        means, _ = self.shape(rest, moment.time)
        quat, _, turning, speed = self.pose(moment.time)
        own = torch.linalg.cross(turning.expand_as(means), means - self.center)
        inner = self.shape_velocity(rest, moment.time)
        if inner is not None:
            own = own + inner
        return own @ quats_to_matrices(quat).mT + speed

    def evolve(self, rest: Gaussians, evidence: StepEvidence) -> Mapping[str, AxisChange]:
        return {} if self.schedule is None else self.schedule.step(self, rest, evidence)

    @torch.no_grad()
    def traced(self, rest: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        """World positions of some Gaussians at some times, metres."""
        rows = probe_rows(len(rest)).to(rest.means.device)
        quats, places = self.placed(times)
        turned = (rest.means[rows] - self.center) @ quats_to_matrices(quats).mT
        return turned + (places + self.center)[:, None]

    @torch.no_grad()
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        """Parameters of this motion with knots at `times` (MovingCurve)."""
        quats, places, turns, speeds = self.poses(times)
        if fit:
            knots = Knots(self.keyframes, movable=True).to(places.device)
            knots.place(times)
            samples = self.placed(fit)[1]
            places, speeds = knots.refit(samples, fit, free_tangents=self.learned)
        found = {
            "keyframe_translations": places,
            "keyframe_quats": quats,
            "translation_tangents": speeds,
            "angular_tangents": turns,
        }
        return {name: value for name, value in found.items() if name in self.knot_axes}

    def regularizers(self) -> dict[str, Tensor]:
        """Squared, per knot.

        "acceleration": second difference of the translations, metres per interval. "tangent":
        learned tangents against finite differences, metres and radians per interval. "track": how
        far its points are from where the track has them, metres.
        """
        penalties: dict[str, Tensor] = {}
        places = self.keyframe_translations[None]
        if len(self.knots) > 2 and not self.knots.movable:
            penalties["acceleration"] = spline.accelerations(places).square().sum(-1).mean()
        if self.learned:
            slack = self.translation_tangents - self.knots.differences(places)[0]
            penalties["tangent"] = slack.square().sum(-1).mean()
            if self.smooth:
                slack = self.angular_tangents - self._angular_differences()
                penalties["tangent"] = penalties["tangent"] + slack.square().sum(-1).mean()
        if self.guide is not None:
            quats, places = self.placed(self.guide.times)
            penalties["track"] = self.guide.deviation(quats, places)
        return penalties
