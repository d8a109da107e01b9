"""The rigid motion of an ObjectTrack, at any time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.device import Time
from hoigs.core.maths.frame_times import frame_at
from hoigs.core.maths.rotations import (
    matrices_to_quats,
    move_rigidly,
    quats_to_matrices,
    slerp,
    turn_between,
)
from hoigs.core.maths.splines import (
    Interval,
    Knots,
    catmull_rom,
    cubic_hermite,
    finite_differences,
    keyframe_position,
    knot_pair,
    uniform_times,
)
from hoigs.core.values.clip import ObjectTrack


class RigidTrack(nn.Module):
    """Poses of an ObjectTrack between its frames: slerp of rotations, CHS of translations.

    Its frames are uniform over [0, 1] unless it has times; a track of a single frame stands still.
    """

    quats: Tensor
    translations: Tensor
    observed: Tensor
    turns: Tensor
    rates: Tensor

    def __init__(self, track: ObjectTrack) -> None:
        super().__init__()
        self.times = track.times if len(track.rotations) > 1 else None
        for name, value in {
            "quats": matrices_to_quats(track.rotations),
            "translations": track.translations,
            "observed": track.observed.to(track.translations),
        }.items():
            frames = value if len(value) > 1 else value.repeat(2, *[1] * (value.dim() - 1))
            self.register_buffer(name, frames.detach().clone())
        turns = turn_between(self.quats[:-1], self.quats[1:])
        self.register_buffer("turns", turns, persistent=False)  # computed from the quaternions
        self._rates = [1 / (b - a) for a, b in pairwise(self.times or ())]
        rates = self.translations.new_tensor(self._rates)
        self.register_buffer("rates", rates, persistent=False)

    def at(self, time: Time) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"]]:
        """Rotation (wxyz) and translation, object to world, at `time` in [0, 1]."""
        place = catmull_rom(self.translations[None], self._position(time))
        return self._rotation(time), place[0]

    def _position(self, time: Time) -> Interval:
        """The frames about a time, and the place between them."""
        if self.times is None:
            return keyframe_position(time, len(self.quats))
        last = len(self.quats) - 1
        return keyframe_position(frame_at(time, last + 1, self.times) / last, last + 1)

    def _frames_per_time(self, k: Any) -> Any:
        """Frames a unit of time from frame k to the next; k is a number or a 0-d tensor."""
        if self.times is None:
            return len(self.turns)
        return self.rates.index_select(0, k).squeeze(0) if isinstance(k, Tensor) else self._rates[k]

    def _rotation(self, time: Time) -> Float[Tensor, " 4"]:
        k, r, _ = self._position(time)
        return slerp(*knot_pair(self.quats[None], k), r)[0]

    def carry(self, means: Float[Tensor, "N 3"], time: Time) -> Float[Tensor, "N 3"]:
        """Points of the object's frame in the world at `time`."""
        rotation, translation = self.at(time)
        return means @ quats_to_matrices(rotation).mT + translation

    def carry_paths(
        self, paths: Float[Tensor, "T P 3"], times: Sequence[float]
    ) -> Float[Tensor, "T P 3"]:
        """`carry` of other points at each of T times, in a few operations for all of them."""
        found = [self._position(time) for time in times]
        k = torch.tensor([at.k for at in found], device=self.quats.device)
        at = Interval(k, self.translations.new_tensor([at.r for at in found])[:, None])
        tangents = finite_differences(self.translations[None])[0]
        translations = cubic_hermite(self.translations, tangents, at)
        rotations = quats_to_matrices(slerp(self.quats[k], self.quats[k + 1], at.r))
        return paths @ rotations.mT + translations[:, None]

    def place(
        self, means: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"], time: Time
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
        """Canonical centres and rotations in the world at `time`."""
        return move_rigidly(means, quats, *self.at(time))

    def velocity(
        self, means: Float[Tensor, "N 3"], time: Time, own: Float[Tensor, "N 3"], unit: float
    ) -> Float[Tensor, "N 3"]:
        """World velocities of points that the track carries, metres per unit of time.

        Args:
            means, own: positions and velocities in the object's frame.
            unit: unit of time, as a fraction of the clip.
        """
        at = self._position(time)
        turn = self.turns.index_select(0, at.k)[0] if isinstance(at.k, Tensor) else self.turns[at.k]
        frames = self._frames_per_time(at.k) * unit
        moving = frames * catmull_rom(self.translations[None], at, derivative=True)
        # slerp turns evenly, and its axis is the same in the frames of both ends
        within = own + torch.linalg.cross((frames * turn).expand_as(means), means)
        return within @ quats_to_matrices(self._rotation(time)).mT + moving

    def knots(
        self, means: Float[Tensor, "N 3"], keyframes: int, *, free_tangents: bool
    ) -> tuple[Float[Tensor, "N K 3"], Float[Tensor, "N K 3"]]:
        """Knots and tangents of each point's path, fitted to all frames of the track.

        A point's position R p + t is linear in R and t, so their twelve entries are fitted once
        for all points.
        """
        values, tangents = (
            torch.einsum("kij,nj->nki", x[:, :9].unflatten(1, (3, 3)), means) + x[:, 9:]
            for x in self._fitted(keyframes, free_tangents)
        )
        return values, tangents

    def _fitted(
        self, keyframes: int, free_tangents: bool
    ) -> tuple[Float[Tensor, "K 12"], Float[Tensor, "K 12"]]:
        """Knots and tangents of the entries of R and t. Frames in which the object was not seen
        weigh a tenth."""
        entries = torch.cat((quats_to_matrices(self.quats).flatten(1), self.translations), dim=1)
        knots, weights = Knots(keyframes).to(entries.device), 0.1 + 0.9 * self.observed
        times = uniform_times(len(entries)) if self.times is None else list(self.times)
        return knots.fit(entries, times, free_tangents=free_tangents, weights=weights)

    def rigid_knots(
        self, keyframes: int, *, free_tangents: bool
    ) -> tuple[
        Float[Tensor, "K 3"], Float[Tensor, "K 3"], Float[Tensor, "K 4"], Float[Tensor, "K 3"]
    ]:
        """Translations, their tangents, rotations (wxyz) and angular velocities at the knots of
        the splines fitted to all frames of the track; per keyframe interval, the angular ones in
        the object's frame.

        The fit is that of `knots`; each knot's 3x3 block is then brought to the nearest rotation,
        and its velocity to that of a rotation.
        """
        values, tangents = self._fitted(keyframes, free_tangents)
        u, _, vh = torch.linalg.svd(values[:, :9].unflatten(1, (3, 3)))
        flip = torch.ones_like(values[:, :3])
        flip[:, 2] = torch.linalg.det(u @ vh)
        turns = (u * flip[:, None, :]) @ vh
        speed = turns.mT @ tangents[:, :9].unflatten(1, (3, 3))
        skew = 0.5 * (speed - speed.mT)
        angular = torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), -1)
        return values[:, 9:], tangents[:, 9:], matrices_to_quats(turns), angular

    def rotations_at(self, keyframes: int) -> Float[Tensor, "K 4"]:
        """The track's rotations at uniform keyframes."""
        return torch.stack([self._rotation(time) for time in uniform_times(keyframes)])

    def largest_step(self, keyframes: int) -> float:
        """Largest rotation between neighbouring uniform keyframes, radians."""
        knots = self.rotations_at(keyframes)
        dot = (knots[1:] * knots[:-1]).sum(-1).abs().clamp(max=1.0)
        return float(2 * torch.acos(dot).max())
