"""deformation:chs: per-Gaussian cubic Hermite splines (HOIGS, Sec. "Object Deformation")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.device import Time
from hoigs.core.maths.rotations import (
    conjugate_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.core.maths.splines import uniform_times
from hoigs.core.model.knot_refit import probe_rows
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced
from hoigs.core.values.topology import TopologyChange, reindex
from hoigs.plugins.deformation.keyframes import Keyframed, KeyframedConfig


class CubicHermiteConfig(KeyframedConfig):
    """The paper's object motion and its ablations."""

    opacity: Literal["keyed", "constant", "auto"] = "keyed"
    """"keyed" over time, linear between knots (the paper), or "constant"; "auto": constant, but
    keyed where the track does not know how the object turns, so that sides come and go, and where
    the object is not seen at the start or the end of the clip, so that it does itself."""


class CubicHermite(Keyframed):
    """M(t) = CHS(t, m) for each Gaussian, plus the interaction's displacement.

    Rotations are slerped between knots, opacity logits are linear, scales and colours constant
    (keep SH degree 0 on an object that turns: higher bands do not turn with it). Tangents and
    `velocity` are in metres per keyframe interval of the knots at the start. Times outside [0, 1]
    are held at the ends.

    With a track, knots and tangents start as the spline nearest to R_f p + t_f over all frames, and
    knot rotations as the track's at the knot's real-valued time; else every knot starts at rest.

    Parameters, allocated in `bind` for N Gaussians and K knots: `keyframe_means` [N, K, 3] and
    `tangents` [N, K, 3] in the world, metres; `keyframe_quats` [N, K, 4]; `opacity_logits`
    [N, K]. That is 11 floats a Gaussian and knot.
    """

    Config: ClassVar = CubicHermiteConfig
    cuda_graph_safe = True
    rates: ClassVar[Mapping[str, str]] = {
        "keyframe_means": "keyframes",
        "tangents": "keyframes",
        "keyframe_quats": "keyframe_rotation",
        "opacity_logits": "opacity",
    }
    resizes: ClassVar[Mapping[str, int]] = dict.fromkeys(rates, 1)
    regularizer_weights: ClassVar[Mapping[str, float]] = {"tangent": 0.01}

    config: CubicHermiteConfig
    rest_quats: Tensor
    keyframe_means: nn.Parameter
    keyframe_quats: nn.Parameter

    def __init__(self, config: CubicHermiteConfig | None = None, **given: Any) -> None:
        super().__init__(config, **given)
        self.keyed = self.config.opacity == "keyed"
        if self.config.opacity == "auto" and self._track is not None:
            comes_or_goes = _unseen_at_an_end(self._track) >= self.config.keyframe_step
            self.keyed = comes_or_goes or not self._track.rotation_known
        names = ["keyframe_means", "keyframe_quats"]
        names += ["tangents"] if self.learned else []
        names += ["opacity_logits"] if self.keyed else []
        self.per_gaussian = (*names, *self.per_gaussian)
        self.knot_axes = dict.fromkeys(names, 1)
        self.time_rows = {} if self.knots.movable else dict.fromkeys(names, self.knots.rows)
        self.owns = frozenset({"means", "quats"} | ({"opacity_logits"} if self.keyed else set()))

    def bind(self, canonical: Gaussians) -> None:
        canonical = canonical.detach()
        rest_quats = normalize_quats(canonical.quats)
        means, tangents, quats = self._initial_knots(canonical.means, rest_quats)
        self.keyframe_means = nn.Parameter(means)
        self.keyframe_quats = nn.Parameter(quats)
        if self.learned:
            self.tangents = nn.Parameter(tangents)
        if self.keyed:
            logits = canonical.opacity_logits[:, None].repeat(1, self.keyframes)
            self.opacity_logits = nn.Parameter(logits)
        self.bind_light(canonical)
        # kept because offsets of new Gaussians come in canonical coordinates
        self.register_buffer("rest_quats", rest_quats.clone())
        self._track = None

    def _initial_knots(
        self, means: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"]
    ) -> tuple[Float[Tensor, "N K 3"], Float[Tensor, "N K 3"], Float[Tensor, "N K 4"]]:
        """Means, tangents and rotations at every knot: at rest, or along the track."""
        count, track = self.keyframes, self.starting_track(means)
        if track is None:
            still = means[:, None].repeat(1, count, 1)
            return still, torch.zeros_like(still), quats[:, None].repeat(1, count, 1)
        values, tangents = track.knots(means, count, free_tangents=self.learned)
        turned = [track.place(means, quats, time)[1] for time in uniform_times(count)]
        return values, tangents, torch.stack(turned, 1)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = displaced(self._means(moment.time), residual)
        quats = self.knots.slerp(self.keyframe_quats, moment.time)
        moved = self.lit(canonical.replace(means=means, quats=quats), canonical)
        if self.keyed:
            logits = self.knots.linear(self.opacity_logits, moment.time)
            moved = moved.replace(opacity_logits=logits)
        return moved

    def means_at(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        return self._means(moment.time)

    def _means(self, time: Time, *, derivative: bool = False) -> Float[Tensor, "N 3"]:
        tangents = self.tangents if self.learned else None
        return self._curves(self.keyframe_means, tangents, time, derivative)

    def _curves(
        self,
        means: Float[Tensor, "P K 3"],
        tangents: Float[Tensor, "P K 3"] | None,
        time: Time,
        derivative: bool = False,
    ) -> Float[Tensor, "P 3"]:
        if tangents is None:
            return self.knots.catmull_rom(means, time, derivative=derivative)
        return self.knots.hermite(means, tangents, time, derivative=derivative)

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """tau(t): exact derivative of the spline, metres per keyframe interval."""
        return self._means(moment.time, derivative=True)

    @torch.no_grad()
    def traced(self, canonical: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        rows = probe_rows(len(canonical)).to(self.keyframe_means.device)
        means = self.keyframe_means[rows]
        tangents = self.tangents[rows] if self.learned else None
        return torch.stack([self._curves(means, tangents, time) for time in times])

    @torch.no_grad()
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        if fit:
            samples = torch.stack([self._means(time) for time in fit]).flatten(1)
            means, tangents = (
                x.unflatten(1, (-1, 3)).transpose(0, 1) for x in self.refitted(samples, fit, times)
            )
        else:
            means = torch.stack([self._means(time) for time in times], 1)
            tangents = torch.stack([self._means(time, derivative=True) for time in times], 1)
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

    def peak_opacity_logits(self, canonical: Gaussians) -> Float[Tensor, " N"]:
        return self.opacity_logits.amax(1) if self.keyed else canonical.opacity_logits

    def on_topology(self, change: TopologyChange) -> None:
        """Rows follow; new Gaussians are displaced in every knot.

        Offsets come in canonical coordinates, and knot k turns a Gaussian by R(q_k) R(q_rest)^-1,
        so each is turned into its knot before it is added, and the tangents gain the finite
        differences of the turned offsets: a child keeps its place on a turning object.
        """
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)
        self.rest_quats = self.rest_quats[change.source].contiguous()
        if not change.offsets.any():
            return
        quats = self.keyframe_quats.data
        inverse = conjugate_quats(self.rest_quats)[:, None].expand_as(quats)
        turns = quats_to_matrices(multiply_quats(quats, inverse))
        offsets = torch.einsum("nkij,nj->nki", turns, change.offsets.to(quats))
        self.keyframe_means.data += offsets
        if self.learned:
            self.tangents.data += self.knots.differences(offsets)

    def regularizers(self) -> dict[str, Tensor]:
        """As `knot_penalties`, of each Gaussian's means."""
        return self.knot_penalties(self.keyframe_means, self.tangents if self.learned else None)


def _unseen_at_an_end(track: ObjectTrack) -> int:
    """Frames before the object is first observed or after it last is, whichever are more."""
    seen = track.observed.nonzero().flatten().tolist()
    return max(seen[0], len(track.observed) - 1 - seen[-1]) if seen else 0
