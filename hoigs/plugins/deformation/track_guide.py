"""How far a rigid motion is from the track that it started on."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.clip import ObjectTrack
from hoigs.core.rotation import matrices_to_quats, quats_to_matrices
from hoigs.plugins.deformation.knot_schedule import probe_rows

UNSEEN = 0.1  # weight of a frame in which nobody saw the object


class TrackGuide(nn.Module):
    """The track's poses at its frames, and points of the object that tell them from others.

    A picture hardly tells how far away a thing is, and says nothing of frames that nobody trains
    on; splines that follow pictures alone leave the track there.
    """

    times: Tensor
    weights: Tensor
    points: Tensor
    told: Tensor

    def __init__(self, track: ObjectTrack) -> None:
        super().__init__()
        frames = len(track.rotations)
        times = [frame / max(frames - 1, 1) for frame in range(frames)]
        points = track.points[probe_rows(len(track.points))]
        weights = UNSEEN + (1 - UNSEEN) * track.observed.to(points)
        # by way of quaternions, as poses are: a matrix that is a little skewed is not an error
        turns = quats_to_matrices(matrices_to_quats(track.rotations))
        told = points @ turns.mT + track.translations[:, None]
        for name, value in {
            "times": torch.tensor(times, dtype=torch.float64),
            "points": points,
            "weights": weights / weights.sum(),
            "told": told,
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
        return ((moved - self.told).square().sum(-1).mean(1) * self.weights).sum()
