"""deformation:tracked-chs: HOIGS's splines about the tracked pose of every frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.maths.rotations import multiply_quats
from hoigs.core.model.knot_refit import probe_rows
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced
from hoigs.core.values.topology import TopologyChange, reindex
from hoigs.plugins.deformation.chs import CubicHermite, CubicHermiteConfig
from hoigs.plugins.deformation.rigid_track import RigidTrack


class TrackedHermiteConfig(CubicHermiteConfig):
    """As CubicHermiteConfig."""

    track: bool = True
    """Be carried by the object's rigid track, where it has one."""


class TrackedHermite(CubicHermite):
    """x(t) = R(t) (p + CHS(t, d)) + T(t): the splines are the object's departure from its track.

    `CubicHermite` starts on the splines nearest to the track and keeps nothing else of it, so what
    the object did between two knots is lost where it is faster than they can follow (a throw, a
    pose that jitters), and each knot learns the object's shape for itself. Here (R, T) is the track
    itself, all of its frames; the shape p is learned from all frames at once; and the splines learn
    the rest: errors of the track that last, and bending. For a curve m that is the same as
    m_k = p + d_k. The paper leaves open how keyframes start.

    Parameters are CubicHermite's, all zero at the start (rotations: no turn): `keyframe_means` and
    `tangents` are d and its tangents, in the object's frame; `keyframe_quats` turn, and
    `opacity_logits` add to, those of the canonical Gaussians. `velocity` is that of the world.
    Without a track the object's frame is the world, and knots learn at CubicHermite's rates.
    """

    Config: ClassVar = TrackedHermiteConfig
    cuda_graph_safe = True
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        **CubicHermite.regularizer_weights,
        "departure": 1000.0,
    }
    # Corrections, like those of a body's poses: at the rate of keyframes each would learn the noise
    # of the four frames about it.
    rates: ClassVar[Mapping[str, str]] = {
        "keyframe_means": "pose",
        "tangents": "pose",
        "keyframe_quats": "pose",
        "opacity_logits": "opacity",
    }

    def __init__(self, config: TrackedHermiteConfig | None = None, **given: Any) -> None:
        super().__init__(config, **given)
        self.carrier = RigidTrack(self._track) if self._track is not None else None
        self._track = None
        self._shape: Tensor | None = None  # of the object in the last forward pass
        self.owns = frozenset()
        if self.carrier is None:  # all of the motion is then the splines' own
            self.rates = CubicHermite.rates  # type: ignore[misc]

    def bind(self, canonical: Gaussians) -> None:
        still = canonical.means.new_zeros(len(canonical), self.keyframes, 3)
        self.keyframe_means = nn.Parameter(still)
        turns = still.new_tensor((1.0, 0.0, 0.0, 0.0)).repeat(len(canonical), self.keyframes, 1)
        self.keyframe_quats = nn.Parameter(turns)
        if self.learned:
            self.tangents = nn.Parameter(still.clone())
        if self.keyed:
            self.opacity_logits = nn.Parameter(still.new_zeros(len(canonical), self.keyframes))
        self.bind_light(canonical)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        time = moment.time
        if self.carrier is not None and self.training:
            self._shape = canonical.means.detach()
        means = canonical.means + self._means(time)
        turns = self.knots.slerp(self.keyframe_quats, time)
        quats = multiply_quats(turns, canonical.quats)  # raw, as the canonical ones
        if self.carrier is not None:
            means, quats = self.carrier.place(means, quats, time)
        moved = canonical.replace(means=displaced(means, residual), quats=quats)
        moved = self.lit(moved, canonical)
        if not self.keyed:
            return moved
        logits = canonical.opacity_logits + self.knots.linear(self.opacity_logits, time)
        return moved.replace(opacity_logits=logits)

    def means_at(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        means = canonical.means + self._means(moment.time)
        return means if self.carrier is None else self.carrier.carry(means, moment.time)

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """tau(t) = R (CHS' + omega x (p + CHS)) + T', exact, metres per keyframe interval."""
        own = self._means(moment.time, derivative=True)
        if self.carrier is None:
            return own
        means = canonical.means + self._means(moment.time)
        return self.carrier.velocity(means, moment.time, own, self.knots.reference)

    @torch.no_grad()
    def traced(self, canonical: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        offsets = super().traced(canonical, times)
        paths = offsets + canonical.means[probe_rows(len(canonical)).to(canonical.means.device)]
        return paths if self.carrier is None else self.carrier.carry_paths(paths, times)

    def peak_opacity_logits(self, canonical: Gaussians) -> Float[Tensor, " N"]:
        logits = canonical.opacity_logits
        return logits + self.opacity_logits.amax(1) if self.keyed else logits

    def regularizers(self) -> dict[str, Tensor]:
        """As CubicHermite; about a track also "departure": what is left of the splines' knots, m^2,
        without the small rigid motion of each that explains most, as errors of a track are rigid.
        It needs a forward pass before, in training."""
        penalties = super().regularizers()
        if self._shape is not None:
            own = nonrigid_part(self.keyframe_means, self._shape)
            penalties["departure"] = own.square().sum(-1).mean()
        return penalties

    def on_topology(self, change: TopologyChange) -> None:
        """Rows follow; the canonical means place a new Gaussian."""
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)
        self._shape = None


def nonrigid_part(
    offsets: Float[Tensor, "N K 3"], points: Float[Tensor, "N 3"]
) -> Float[Tensor, "N K 3"]:
    """Offsets of points without the translation and the small rotation, for each k, that come
    nearest to them: o - t - w x p, least squares."""
    offsets = offsets - offsets.mean(0, keepdim=True)
    arms = points - points.mean(0, keepdim=True)
    spread = arms.mT @ arms / len(arms)
    unit = torch.eye(3, dtype=spread.dtype, device=spread.device)
    inertia = spread.trace() * unit - spread
    inertia = inertia + (1e-6 * spread.trace() + 1e-12) * unit  # a straight bar
    x, y, z = inertia  # its inverse by hand: recordings of a GPU's work take no solver
    adjugate = torch.stack([y.cross(z, dim=0), z.cross(x, dim=0), x.cross(y, dim=0)])
    moments = torch.linalg.cross(arms[:, None], offsets).mean(0)
    turns = moments @ adjugate / (x @ adjugate[0])
    return offsets - torch.linalg.cross(turns.expand_as(offsets), arms[:, None].expand_as(offsets))
