"""deformation:chs: per-Gaussian cubic Hermite splines (HOIGS, Sec. "Object Deformation")."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

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
from hoigs.core.rotation import multiply_quats, normalize_quats, quats_to_matrices
from hoigs.core.topology import AxisChange, TopologyChange, reindex
from hoigs.plugins.deformation.knot_schedule import AdaptiveKnotsConfig, KnotSchedule, probe_rows
from hoigs.plugins.deformation.knots import Knots
from hoigs.plugins.deformation.resizing import Resizing
from hoigs.plugins.deformation.rigid_track import RigidTrack

Tangents = Literal["learned", "finite-difference"]
Opacity = Literal["keyed", "constant"]

LARGE_STEP = math.radians(120)


class CubicHermiteConfig(ComponentConfig):
    """The paper's object motion and its ablations.

    Attributes:
        keyframes: number of knots; None derives it from `keyframe_step` and the clip's length;
            "adaptive" starts from that and lets training insert and remove knots.
        keyframe_step: frames between knots (the paper's 4).
        tangents: "learned" velocities (the paper) or "finite-difference" of neighbouring knots.
        opacity: "keyed" over time, linear between knots (the paper), or "constant".
        track: start from the object's rigid track, where it has one, else at rest.
        adaptive: when and how knots change, if `keyframes` is "adaptive".
    """

    keyframes: Annotated[int, Field(ge=2)] | Literal["adaptive"] | None = None
    keyframe_step: int = Field(4, ge=1)
    tangents: Tangents = "learned"
    opacity: Opacity = "keyed"
    track: bool = True
    adaptive: AdaptiveKnotsConfig = Field(default_factory=AdaptiveKnotsConfig)


class CubicHermite(Resizing, DeformationModel):
    """M(t) = CHS(t, m) for each Gaussian, plus the interaction's displacement.

    Rotations are slerped between knots, opacity logits are linear, scales and colours constant
    (keep SH degree 0 on an object that turns: higher bands do not turn with it). Tangents and
    `velocity` are in metres per keyframe interval. Times outside [0, 1] are held at the ends.

    Parameters, allocated in `bind` for N Gaussians and K knots: `keyframe_means` [N, K, 3] and
    `tangents` [N, K, 3] in the world, metres; `keyframe_quats` [N, K, 4]; `opacity_logits`
    [N, K]. That is 11 floats a Gaussian and knot.

    Args:
        keyframes: K; or None with `num_frames`, for one every `keyframe_step` frames.
        num_frames: frames of the clip; by default those of the track.
        track: rest is then the canonical object; knots and tangents start as the spline nearest
            to R_f p + t_f over all frames, knot rotations as the track's at the knot's real-valued
            time. Without a track every knot starts at rest.
        schedule: lets knots come and go in training (at least 4), the same for all Gaussians;
            tangents and `velocity` stay per interval of the knots at the start. None keeps them.
    """

    provides = frozenset({"velocity"})
    recordable = True
    rates: ClassVar[Mapping[str, str]] = {
        "keyframe_means": "keyframes",
        "tangents": "keyframes",
        "keyframe_quats": "keyframe_rotation",
        "opacity_logits": "opacity",
    }

    resizes: ClassVar[Mapping[str, int]] = dict.fromkeys(rates, 1)

    regularizer_weights: ClassVar[Mapping[str, float]] = {"tangent": 0.01}

    rest_quats: Tensor

    def __init__(
        self,
        keyframes: int | None = None,
        *,
        keyframe_step: int = 4,
        num_frames: int | None = None,
        tangents: Tangents = "learned",
        opacity: Opacity = "keyed",
        track: ObjectTrack | None = None,
        schedule: KnotSchedule | None = None,
    ) -> None:
        super().__init__()
        if keyframes is None:
            if num_frames is None and track is None:
                raise ValueError(
                    "CubicHermite needs `keyframes`, or `num_frames` or a `track` to derive them"
                )
            frames = num_frames if num_frames is not None else len(track.rotations)  # type: ignore[union-attr]
            keyframes = spline.keyframe_count(frames, keyframe_step)
        if keyframes < 2:
            raise ValueError(f"CubicHermite needs at least 2 keyframes, got {keyframes}")
        if schedule is not None:
            keyframes = max(keyframes, schedule.config.minimum)
        self.knots, self.schedule = Knots(keyframes, movable=schedule is not None), schedule
        self.keyframes = keyframes  # at the start: features take the size of their own from it
        self.learned, self.keyed = tangents == "learned", opacity == "keyed"
        names = ["keyframe_means", "keyframe_quats"]
        names += ["tangents"] if self.learned else []
        names += ["opacity_logits"] if self.keyed else []
        self.per_gaussian = tuple(names)
        self.knot_axes: Mapping[str, int] = dict.fromkeys(names, 1)
        self.owns = frozenset({"means", "quats"} | ({"opacity_logits"} if self.keyed else set()))
        self.rest_space = "canonical" if track is not None else "world"
        self._track = track

    @classmethod
    def from_config(cls, config: CubicHermiteConfig, context: BuildContext) -> Self:
        adaptive = config.keyframes == "adaptive"
        return cls(
            None if config.keyframes == "adaptive" else config.keyframes,
            keyframe_step=config.keyframe_step,
            num_frames=context.clip.num_frames if context.clip is not None else None,
            tangents=config.tangents,
            opacity=config.opacity,
            track=context.object_track if config.track else None,
            schedule=KnotSchedule.from_context(config.adaptive, context) if adaptive else None,
        )

    def bind(self, rest: Gaussians) -> None:
        rest = rest.detach()
        means, tangents, quats = self._initial_knots(rest.means, normalize_quats(rest.quats))
        self.keyframe_means = nn.Parameter(means)
        self.keyframe_quats = nn.Parameter(quats)
        if self.learned:
            self.tangents = nn.Parameter(tangents)
        if self.keyed:
            logits = rest.opacity_logits[:, None].repeat(1, self.keyframes)
            self.opacity_logits = nn.Parameter(logits)
        # kept because offsets of new Gaussians come in rest coordinates
        self.register_buffer("rest_quats", normalize_quats(rest.quats).clone())
        self._track = None

    def _initial_knots(
        self, means: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]
    ) -> tuple[Float[Tensor, "N K 3"], Float[Tensor, "N K 3"], Float[Tensor, "N K 4"]]:
        """Means, tangents and rotations at every knot: at rest, or along the track."""
        count = self.keyframes
        if self._track is None:
            still = means[:, None].repeat(1, count, 1)
            return still, torch.zeros_like(still), quats[:, None].repeat(1, count, 1)
        track = RigidTrack(self._track).to(means)
        if track.largest_step(count) > LARGE_STEP:
            warnings.warn(
                f"the object turns {math.degrees(track.largest_step(count)):.0f} degrees between "
                "two keyframes: splines cut such corners and slerp may turn the wrong way; use "
                "more keyframes (a smaller keyframe_step)",
                stacklevel=3,
            )
        knots, tangents = track.knots(means, count, free_tangents=self.learned)
        times = [k / (count - 1) for k in range(count)]
        turned = [track.place(means, quats, time)[1] for time in times]
        return knots, tangents, torch.stack(turned, 1)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = self._means(moment.time)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        quats = self.knots.slerp(self.keyframe_quats, moment.time)
        moved = replace(rest, means=means, quats=quats)
        if self.keyed:
            logits = self.knots.linear(self.opacity_logits, moment.time)
            moved = replace(moved, opacity_logits=logits)
        return moved

    def means_at(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        del rest
        return self._means(moment.time)

    def _means(self, time: Time, *, derivative: bool = False) -> Float[Tensor, "N 3"]:
        if self.learned:
            return self.knots.hermite(
                self.keyframe_means, self.tangents, time, derivative=derivative
            )
        return self.knots.catmull_rom(self.keyframe_means, time, derivative=derivative)

    def velocity(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """tau(t): exact derivative of the spline, metres per keyframe interval."""
        del rest
        return self._means(moment.time, derivative=True)

    def evolve(self, rest: Gaussians, evidence: StepEvidence) -> Mapping[str, AxisChange]:
        return {} if self.schedule is None else self.schedule.step(self, rest, evidence)

    @torch.no_grad()
    def traced(self, rest: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        """World positions of some Gaussians at some times, metres (MovingCurve)."""
        rows = probe_rows(len(rest)).to(self.keyframe_means.device)
        values = self.keyframe_means[rows]
        if not self.learned:
            return torch.stack([self.knots.catmull_rom(values, time) for time in times])
        tangents = self.tangents[rows]
        return torch.stack([self.knots.hermite(values, tangents, time) for time in times])

    @torch.no_grad()
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        """Parameters of this motion with knots at `times` (MovingCurve)."""
        means = torch.stack([self._means(time) for time in times], 1)
        tangents = torch.stack([self._means(time, derivative=True) for time in times], 1)
        if fit:
            knots = Knots(self.keyframes, movable=True).to(means.device)
            knots.place(times)
            samples = torch.stack([self._means(time) for time in fit]).flatten(1)
            refitted = knots.refit(samples, fit, free_tangents=self.learned)
            means, tangents = (x.unflatten(1, (-1, 3)).transpose(0, 1) for x in refitted)
        quats = [self.knots.slerp(self.keyframe_quats, time) for time in times]
        found = {
            "keyframe_means": means,
            "tangents": tangents,
            "keyframe_quats": torch.stack(quats, 1),
        }
        if self.keyed:
            logits = [self.knots.linear(self.opacity_logits, time) for time in times]
            found["opacity_logits"] = torch.stack(logits, 1)
        return {name: found[name] for name in self.knot_axes}

    def peak_opacity_logits(self, rest: Gaussians) -> Float[Tensor, " N"]:
        return self.opacity_logits.amax(1) if self.keyed else rest.opacity_logits

    def on_topology(self, change: TopologyChange) -> None:
        """Rows follow; new Gaussians are displaced in every knot.

        Offsets come in rest coordinates, and knot k turns a Gaussian by R(q_k) R(q_rest)^-1, so
        each is turned into its knot before it is added, and the tangents gain the finite
        differences of the turned offsets: a child keeps its place on a turning object.
        """
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)
        self.rest_quats = self.rest_quats[change.source].contiguous()
        if not change.offsets.any():
            return
        conjugate = self.rest_quats * self.rest_quats.new_tensor((1.0, -1.0, -1.0, -1.0))
        quats = self.keyframe_quats.data
        turns = multiply_quats(quats, conjugate[:, None].expand_as(quats))
        offsets = torch.einsum("nkij,nj->nki", quats_to_matrices(turns), change.offsets.to(quats))
        self.keyframe_means.data += offsets
        if self.learned:
            self.tangents.data += self.knots.differences(offsets)

    def regularizers(self) -> dict[str, Tensor]:
        """Squared, per Gaussian and knot, in metres per interval.

        "acceleration": second difference of uniform knots. "tangent": learned tangents against the
        finite differences, which an interval's few frames cannot pin down alone (methods A.3).
        """
        penalties: dict[str, Tensor] = {}
        if len(self.knots) > 2 and not self.knots.movable:
            jerks = spline.accelerations(self.keyframe_means)
            penalties["acceleration"] = jerks.square().sum(-1).mean()
        if self.learned:
            difference = self.tangents - self.knots.differences(self.keyframe_means)
            penalties["tangent"] = difference.square().sum(-1).mean()
        return penalties
