"""deformation:tracked-chs: HOIGS's splines about the tracked pose of every frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.clip import ObjectTrack
from hoigs.core.clock import Time
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import multiply_quats
from hoigs.core.topology import TopologyChange, reindex
from hoigs.plugins.deformation.chs import CubicHermite, CubicHermiteConfig
from hoigs.plugins.deformation.knot_schedule import probe_rows
from hoigs.plugins.deformation.rigid_track import RigidTrack


class TrackedHermiteConfig(CubicHermiteConfig):
    """As CubicHermiteConfig.

    Attributes:
        track: be carried by the object's rigid track, where it has one.
    """


class TrackedHermite(CubicHermite):
    """x(t) = R(t) (p + CHS(t, d)) + T(t): the splines tell how the object departs from its track.

    `CubicHermite` starts on the splines nearest to the track and keeps nothing else of it, so what
    the object did between two knots is lost where it is faster than they can follow (a throw, a
    pose that jitters), and each knot learns the object's shape for itself. Here (R, T) is the track
    itself, all of its frames; the shape p is learned from all frames at once; and the splines learn
    what is left: errors of the track that last, and what bends. For a curve m that is the same as
    m_k = p + d_k. The paper leaves open how keyframes start (methods A.3).

    Parameters are CubicHermite's, all zero at the start (rotations: no turn): `keyframe_means` and
    `tangents` are d and its tangents, in the object's frame; `keyframe_quats` turn, and
    `opacity_logits` add to, those of rest. `velocity` is that of the world. Without a track the
    object's frame is the world, and knots learn at CubicHermite's rates.

    Args:
        track: poses that carry the splines; rest is then the canonical object. Others: as
            CubicHermite.
    """

    recordable = True
    # corrections, like those of a body's poses: at the rate of keyframes each would learn the noise
    # of the four frames about it
    rates: ClassVar[Mapping[str, str]] = {
        "keyframe_means": "pose",
        "tangents": "pose",
        "keyframe_quats": "pose",
        "opacity_logits": "opacity",
    }

    def __init__(
        self,
        keyframes: int | None = None,
        *,
        num_frames: int | None = None,
        track: ObjectTrack | None = None,
        **motion: Any,
    ) -> None:
        if num_frames is None and track is not None:
            num_frames = len(track.rotations)
        super().__init__(keyframes, num_frames=num_frames, **motion)
        self.carrier = RigidTrack(track) if track is not None else None
        self.rest_space = "canonical" if track is not None else "world"
        self.owns = frozenset()
        if track is None:  # all of the motion is then the splines' own
            self.rates = CubicHermite.rates  # type: ignore[misc]

    def bind(self, rest: Gaussians) -> None:
        still = rest.means.new_zeros(len(rest), self.keyframes, 3)
        self.keyframe_means = nn.Parameter(still)
        turns = still.new_tensor((1.0, 0.0, 0.0, 0.0)).repeat(len(rest), self.keyframes, 1)
        self.keyframe_quats = nn.Parameter(turns)
        if self.learned:
            self.tangents = nn.Parameter(still.clone())
        if self.keyed:
            self.opacity_logits = nn.Parameter(still.new_zeros(len(rest), self.keyframes))

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        time = moment.time
        means = rest.means + self._means(time)
        turns = self.knots.slerp(self.keyframe_quats, time)
        quats = multiply_quats(turns, rest.quats)  # raw, as those of rest
        if self.carrier is not None:
            means, quats = self.carrier.place(means, quats, time)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        moved = rest.replace(means=means, quats=quats)
        if not self.keyed:
            return moved
        logits = rest.opacity_logits + self.knots.linear(self.opacity_logits, time)
        return moved.replace(opacity_logits=logits)

    def means_at(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        return self._carried(rest.means + self._means(moment.time), moment.time)

    def _carried(self, means: Float[Tensor, "N 3"], time: Time) -> Float[Tensor, "N 3"]:
        return means if self.carrier is None else self.carrier.carry(means, time)

    def velocity(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """tau(t) = R (CHS' + omega x (p + CHS)) + T', exact, metres per keyframe interval."""
        own = self._means(moment.time, derivative=True)
        if self.carrier is None:
            return own
        means = rest.means + self._means(moment.time)
        return self.carrier.velocity(means, moment.time, own, self.knots.reference)

    @torch.no_grad()
    def traced(self, rest: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        offsets = super().traced(rest, times)
        means = rest.means[probe_rows(len(rest)).to(rest.means.device)]
        pairs = zip(offsets, times, strict=True)
        return torch.stack([self._carried(means + offset, time) for offset, time in pairs])

    def peak_opacity_logits(self, rest: Gaussians) -> Float[Tensor, " N"]:
        logits = rest.opacity_logits
        return logits + self.opacity_logits.amax(1) if self.keyed else logits

    def on_topology(self, change: TopologyChange) -> None:
        """Rows follow; where a new Gaussian stands is rest's to say."""
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)
