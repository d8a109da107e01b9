"""deformation:rigid-spline: one SE(3) spline moves a whole object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.device import Time
from hoigs.core.maths.rotation_splines import angular_differences, hermite_factors, hermite_quats
from hoigs.core.maths.rotations import (
    matrices_to_quats,
    move_rigidly,
    normalize_quats,
    quats_to_matrices,
    slerp,
    turn_between,
)
from hoigs.core.maths.splines import Interval, Times, cubic_hermite, one_time, uniform_times
from hoigs.core.model.knot_refit import probe_rows
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced
from hoigs.plugins.deformation.keyframes import Keyframed, KeyframedConfig
from hoigs.plugins.deformation.rigid_track import RigidTrack

# The distance of a rigid motion from the track that it started on.

UNSEEN = 0.1  # weight of a frame in which the object was not seen


class TrackGuide(nn.Module):
    """The track's poses at its frames, and where they carry some points of the object.

    A picture hardly determines how far away an object is, and frames that are not trained on
    determine nothing; splines that follow pictures alone leave the track there.
    """

    times: Tensor
    weights: Tensor
    points: Tensor
    carried: Tensor

    def __init__(self, track: ObjectTrack) -> None:
        super().__init__()
        frames = len(track.rotations)
        times = uniform_times(frames) if frames > 1 else [0.0]
        points = track.points[probe_rows(len(track.points))]
        weights = UNSEEN + (1 - UNSEEN) * track.observed.to(points)
        # through quaternions, as poses are, so that a slightly skewed matrix is not an error
        turns = quats_to_matrices(matrices_to_quats(track.rotations))
        carried = points @ turns.mT + track.translations[:, None]
        for name, value in {
            "times": torch.tensor(times, dtype=torch.float64),
            "points": points,
            "weights": weights / weights.sum(),
            "carried": carried,
        }.items():
            self.register_buffer(name, value.detach().clone(), persistent=False)

    def deviation(
        self, quats: Float[Tensor, "F 4"], places: Float[Tensor, "F 3"]
    ) -> Float[Tensor, ""]:
        """Mean square distance of the points from where the track has them, square metres.

        Args:
            quats, places: the motion's poses at `times`, object to world.
        """
        moved = self.points @ quats_to_matrices(quats).mT + places[:, None]
        return ((moved - self.carried).square().sum(-1).mean(1) * self.weights).sum()


class RigidSplineConfig(KeyframedConfig):
    """One rigid motion for all Gaussians of an object."""

    rotation: Literal["cubic", "slerp"] = "cubic"
    """"cubic", smooth, or "slerp", at constant speed between knots."""
    about_track: bool = False
    """Move the object by all frames of its track, and let the spline correct them; else the spline
    starts near the track, and moves the object alone."""


class RigidSpline(Keyframed):
    """x(t) = R(t) (p - c) + c + T(t): every Gaussian moves with the object, and turns with it.

    T is a cubic Hermite spline, R a slerp or the cubic curve of `hermite_quats`; c is zero for an
    object with a track, else the centre of its Gaussians. Shapes, colours and positions p in the
    object's frame are the canonical Gaussians', trained as usual (keep SH degree 0 on an object
    that turns: higher bands do not turn with it). Times outside [0, 1] are held at the ends.

    Parameters, for K knots: `keyframe_translations` and `translation_tangents` [K, 3], metres;
    `keyframe_quats` [K, 4]; `angular_tangents` [K, 3], radians, in the object's frame. Tangents
    and `velocity` are per keyframe interval of the K knots at the start. With a track they start
    as the splines nearest to it; with `about_track` they start at rest, x(t) is moved by the
    track's pose besides, as in `TrackedHermite`, and their rates are those of corrections.
    """

    Config: ClassVar = RigidSplineConfig
    cuda_graph_safe = True
    rates: ClassVar[Mapping[str, str]] = {
        "keyframe_translations": "keyframes",
        "translation_tangents": "keyframes",
        "keyframe_quats": "keyframe_rotation",
        "angular_tangents": "keyframe_rotation",
    }
    resizes: ClassVar[Mapping[str, int]] = dict.fromkeys(rates, 0)
    # "tangent" a hundredth of chs's: here all Gaussians share one curve
    regularizer_weights: ClassVar[Mapping[str, float]] = {"tangent": 1e-4, "track": 30.0}

    config: RigidSplineConfig
    center: Tensor
    keyframe_translations: nn.Parameter
    translation_tangents: nn.Parameter
    keyframe_quats: nn.Parameter
    angular_tangents: nn.Parameter

    def __init__(self, config: RigidSplineConfig | None = None, **given: Any) -> None:
        super().__init__(config, **given)
        self.smooth = self.config.rotation == "cubic"
        names = ["keyframe_translations", "keyframe_quats"]
        names += ["translation_tangents"] if self.learned else []
        names += ["angular_tangents"] if self.learned and self.smooth else []
        self.knot_axes = dict.fromkeys(names, 0)
        self.guide = TrackGuide(self._track) if self._track is not None else None
        self.carrier: RigidTrack | None = None
        if self._track is not None and self.config.about_track:
            self.carrier, self._track, self.guide = RigidTrack(self._track), None, None
            corrections = dict.fromkeys(RigidSpline.rates, "pose")
            self.rates = {**type(self).rates, **corrections}  # type: ignore[misc]

    def bind(self, canonical: Gaussians) -> None:
        means = canonical.means.detach()
        values = self._initial(means)
        for name in self.knot_axes:
            setattr(self, name, nn.Parameter(values[name].to(means).contiguous()))
        center = torch.zeros(3) if self._track is not None or len(means) == 0 else means.mean(0)
        self.register_buffer("center", center.to(means).clone())
        self.bind_light(canonical)
        self._track = None

    def _initial(self, means: Tensor) -> dict[str, Tensor]:
        """Parameters at rest, or of the splines nearest to the track."""
        count, track = self.keyframes, self.starting_track(means)
        if track is None:
            places = velocities = angular = means.new_zeros(count, 3)
            quats = means.new_tensor((1.0, 0.0, 0.0, 0.0)).repeat(count, 1)
        else:
            places, velocities, quats, angular = track.rigid_knots(
                count, free_tangents=self.learned
            )
            if not (self.smooth and self.learned):  # knots alone: on the track, not near it
                quats = track.rotations_at(count)
        return {
            "keyframe_translations": places.clone(),
            "translation_tangents": velocities.clone(),
            "keyframe_quats": quats,
            "angular_tangents": angular.clone(),
        }

    def poses(
        self, times: Times
    ) -> tuple[
        Float[Tensor, "T 4"], Float[Tensor, "T 3"], Float[Tensor, "T 3"], Float[Tensor, "T 3"]
    ]:
        """Rotations (wxyz), translations, and their velocities per keyframe interval: the angular
        ones in the object's frame, radians, the linear ones in the world, metres."""
        at = self.knots.at_times(times, self.keyframe_translations)
        values, tangents = self.keyframe_translations, self._tangents()
        places = cubic_hermite(values, tangents, at)
        speeds = cubic_hermite(values, tangents, at, derivative=True)
        if not self.smooth:
            a, b = self._ends(at)
            return slerp(a, b, at.r), places, turn_between(a, b) / at.length, speeds
        quats, turning = hermite_quats(*self._ends(at), *self._end_velocities(at), at.r, at.length)
        return quats, places, turning, speeds

    def placed(self, times: Times) -> tuple[Float[Tensor, "T 4"], Float[Tensor, "T 3"]]:
        """Rotations and translations of `poses`, without the cost of their velocities."""
        at = self.knots.at_times(times, self.keyframe_translations)
        places = cubic_hermite(self.keyframe_translations, self._tangents(), at)
        if not self.smooth:
            return slerp(*self._ends(at), at.r), places
        factors = hermite_factors(*self._ends(at), *self._end_velocities(at), at.r, at.length)
        return factors[0], places

    def _ends(self, at: Interval) -> tuple[Float[Tensor, "T 4"], Float[Tensor, "T 4"]]:
        """Rotations at the two knots of each interval."""
        return self.keyframe_quats[at.k], self.keyframe_quats[at.k + 1]

    def _end_velocities(self, at: Interval) -> tuple[Float[Tensor, "T 3"], Float[Tensor, "T 3"]]:
        """Angular velocities at the two knots of each interval."""
        velocities = self.angular_tangents if self.learned else self._angular_differences()
        return velocities[at.k], velocities[at.k + 1]

    def _tangents(self) -> Float[Tensor, "K 3"]:
        if self.learned:
            return self.translation_tangents
        return self.knots.differences(self.keyframe_translations[None])[0]

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
        self, canonical: Gaussians, time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        """Centres and rotations in the object's frame; here they stay."""
        return canonical.means, canonical.quats

    def shape_velocity(self, canonical: Gaussians, time: Time) -> Float[Tensor, "N 3"] | None:
        """Derivative of `shape`'s centres per keyframe interval; None while they stay."""
        return None

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means, quats = self.shape(canonical, moment.time)
        (quat,), (place,) = self.placed(one_time(moment.time))
        means, quats = move_rigidly(
            means - self.center, normalize_quats(quats), quat, self.center + place
        )
        if self.carrier is not None:
            means, quats = self.carrier.place(means, quats, moment.time)
        moved = canonical.replace(means=displaced(means, residual), quats=quats)
        return self.lit(moved, canonical)

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """Exact time derivative of the means, metres per keyframe interval."""
        means, _ = self.shape(canonical, moment.time)
        quat, place, turning, speed = self.pose(moment.time)
        own = torch.linalg.cross(turning.expand_as(means), means - self.center)
        inner = self.shape_velocity(canonical, moment.time)
        if inner is not None:
            own = own + inner
        rotation = quats_to_matrices(quat).mT
        own = own @ rotation + speed
        if self.carrier is None:
            return own
        means = (means - self.center) @ rotation + self.center + place
        return self.carrier.velocity(means, moment.time, own, self.knots.reference)

    @torch.no_grad()
    def traced(self, canonical: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        rows = probe_rows(len(canonical)).to(canonical.means.device)
        quats, places = self.placed(times)
        shapes = torch.stack([self.shape(canonical, time)[0][rows] for time in times])
        turned = (shapes - self.center) @ quats_to_matrices(quats).mT
        paths = turned + (places + self.center)[:, None]
        return paths if self.carrier is None else self.carrier.carry_paths(paths, times)

    @torch.no_grad()
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        quats, places, turns, speeds = self.poses(times)
        if fit:
            places, speeds = self.refitted(self.placed(fit)[1], fit, times)
        found = {
            "keyframe_translations": places,
            "keyframe_quats": quats,
            "translation_tangents": speeds,
            "angular_tangents": turns,
        }
        return {name: value for name, value in found.items() if name in self.knot_axes}

    def regularizers(self) -> dict[str, Tensor]:
        """As `knot_penalties`, "tangent" with that of angular velocities, radians per interval.

        "track": how far points of the object are from where the track has them, square metres.
        """
        tangents = self.translation_tangents[None] if self.learned else None
        penalties = self.knot_penalties(self.keyframe_translations[None], tangents)
        if self.learned and self.smooth:
            apart = self.angular_tangents - self._angular_differences()
            penalties["tangent"] = penalties["tangent"] + apart.square().sum(-1).mean()
        if self.guide is not None:
            penalties["track"] = self.guide.deviation(*self.placed(self.guide.times))
        return penalties
