"""Shape of Motion (Wang et al., ICCV 2025, arXiv:2407.13764): motion by a few shared SE(3) bases.

    python examples/papers/shape_of_motion.py builtin:carry tracks.npz
    hoigs train builtin:carry --plugin examples/papers/shape_of_motion.py \
        --spec examples/papers/shape-of-motion.yaml

The first command writes 2D tracks from what is known of a clip's bodies and objects; for a
recording they come from a tracker such as CoTracker.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import normalize

import hoigs
from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_quats,
    multiply_quats,
)
from hoigs.core.maths.splines import accelerations, keyframe_position, linear
from hoigs.core.values.tokens import Residual, displaced


class BasesConfig(ComponentConfig):
    bases: int = Field(default=10, ge=1)
    """B, trajectories that all Gaussians of an entity share."""


class SE3Bases(hoigs.DeformationModel):
    """x(t) = R(t) (x - c) + c + p(t), [R, p] = sum_b w_b [R_b, p_b](t), about the centre c (Eq. 2).

    Each basis has a rotation, the first two columns of a matrix, and a shift for each frame; w is
    the softmax of numbers that each Gaussian has. The paper's bases start from clustered 3D tracks,
    these from the rigid motion that the clip knows of the entity.
    """

    Config: ClassVar = BasesConfig
    kinds = frozenset({"human", "object"})
    per_gaussian = ("weights",)
    rates: ClassVar = {"turns": "keyframe_rotation", "shifts": "keyframes", "weights": "embedding"}
    regularizer_weights: ClassVar = {"smooth_bases": 0.1}
    input_space = "world"
    center: Tensor

    def __init__(
        self,
        config: BasesConfig | None = None,
        *,
        rotations: Float[Tensor, "F 3 3"],
        translations: Float[Tensor, "F 3"],
        canonical: int,
    ) -> None:
        """The rigid motion at the start, and the frame in which the canonical Gaussians are."""
        super().__init__()
        self.config, self.start = config or BasesConfig(), (rotations, translations, canonical)

    @classmethod
    def from_config(cls, config: BasesConfig, context: BuildContext) -> SE3Bases:
        track, body = context.object_track, context.body_track
        if track is not None:  # its points stand where it was seen first
            first = int(track.observed.nonzero()[0]) if track.observed.any() else 0
            motion = track.rotations, track.translations
            return cls(config, rotations=motion[0], translations=motion[1], canonical=first)
        if body is None:
            raise ValueError("deformation:se3-bases needs the track of a person or an object")
        poses = body.poses
        turns = axis_angle_to_matrices(poses.global_orient)
        middle = len(poses.transl) // 2
        return cls(config, rotations=turns, translations=poses.transl, canonical=middle)

    def bind(self, canonical: hoigs.Gaussians) -> None:
        rotations, places, first = self.start
        means = canonical.means.detach()
        center = means.mean(0) if len(means) else means.new_zeros(3)
        turns = rotations @ rotations[first].mT  # from the canonical frame
        shifts = (turns @ (center - places[first])[:, None])[..., 0] + places - center
        count = self.config.bases
        self.register_buffer("center", center)
        self.turns = nn.Parameter(turns[..., :2].mT.flatten(1).expand(count, -1, -1).clone())
        self.shifts = nn.Parameter(shifts.expand(count, -1, -1).clone())
        self.weights = nn.Parameter(torch.randn(len(means), count).to(center))

    def forward(
        self,
        canonical: hoigs.Gaussians,
        moment: hoigs.Moment,
        residual: Residual | None = None,
    ) -> hoigs.Gaussians:
        at, shares = keyframe_position(moment.time, self.turns.shape[1]), self.weights.softmax(-1)
        first, second = (shares @ linear(self.turns, at)).unflatten(-1, (2, 3)).unbind(-2)
        x = normalize(first, dim=-1)
        y = normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
        rotations = torch.stack((x, y, torch.linalg.cross(x, y)), -1)
        arms = (rotations @ (canonical.means - self.center)[..., None])[..., 0]
        means = arms + self.center + shares @ linear(self.shifts, at)
        quats = multiply_quats(matrices_to_quats(rotations), canonical.quats)
        return canonical.replace(means=displaced(means, residual), quats=quats)

    def regularizers(self) -> dict[str, Tensor]:
        bends = [accelerations(values).square().mean() for values in (self.turns, self.shifts)]
        return {"smooth_bases": torch.stack(bends).sum()}


@hoigs.hookimpl
def hoigs_components():  # type: ignore[no-untyped-def]
    target, config = f"{__name__}:SE3Bases", f"{__name__}:BasesConfig"
    yield hoigs.Component("deformation:se3-bases", target, config, summary="shared SE(3) bases")


@torch.no_grad()
def write_tracks(clip: hoigs.Clip, path: str | Path, count: int = 200) -> None:
    """Points of people and objects in all frames, visible where the clip's depth agrees (2 cm)."""
    paths: list[Tensor] = []  # [F, P, 3], world
    for name in clip.bodies:
        body: Any = hoigs.AnnyBody()
        rows = torch.randperm(len(body(clip.moments[0].poses[name]).vertices))[:count]
        paths.append(torch.stack([body(m.poses[name]).vertices[rows] for m in clip.moments]))
    for track in clip.objects.values():
        rows = torch.randperm(len(track.points))[:count]
        paths.append(track.points[rows] @ track.rotations.mT + track.translations[:, None])
    xy, visible = [], []
    for frame, points in zip(clip, torch.cat(paths, 1), strict=True):
        pixels, depth = frame.camera.project(points)
        column, row = pixels.floor().long().unbind(-1)
        inside = frame.camera.shows(pixels, depth)
        assert frame.depth is not None
        seen = frame.depth[
            row.clamp(0, frame.camera.height - 1), column.clamp(0, frame.camera.width - 1)
        ]
        xy.append(pixels)
        visible.append(inside & ((seen - depth).abs() < 0.02))
    size = (clip.cameras[0].width, clip.cameras[0].height)
    np.savez(path, xy=torch.stack(xy), visible=torch.stack(visible), size=np.array(size))


if __name__ == "__main__":
    torch.manual_seed(0)
    write_tracks(hoigs.read_clip(sys.argv[1]), sys.argv[2])
