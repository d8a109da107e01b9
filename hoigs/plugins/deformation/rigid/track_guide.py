"""The distance of a rigid motion from the track that it started on."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.maths.knots import uniform_times
from hoigs.core.maths.rotations import matrices_to_quats, quats_to_matrices
from hoigs.core.model.knot_refit import probe_rows
from hoigs.core.values.clip import ObjectTrack

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
