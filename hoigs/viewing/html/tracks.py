"""Tracks: the entities of a run over time, sorted by how they move, and quantised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import (
    kabsch,
    matrices_to_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.values.gaussians import Gaussians

STILL_M = 5e-4  # an entity whose Gaussians all stay within this is stored once
RIGID_M = 2e-3  # percentile 99 of what may be left of a motion that is stored as poses
STEADY = 0.02  # change of colour, opacity and logarithm of scales of an entity that is stored once

Motion = Literal["static", "rigid", "moving"]


@dataclass(frozen=True)
class Track:
    """One entity over K keys (times); static and rigid ones have one key of Gaussians.

    Attributes:
        means: metres. quats: wxyz, unit, of the nearer sign from key to key. log_scales: of metres.
        rgba: colour, which may be brighter than 1 where a Gaussian is transparent, and opacity.
        poses: of a rigid one, quaternion and translation in every key.
    """

    name: str
    motion: Motion
    means: Float[Tensor, "K N 3"]
    quats: Float[Tensor, "K N 4"]
    log_scales: Float[Tensor, "K N 3"]
    rgba: Float[Tensor, "K N 4"]
    poses: Float[Tensor, "F 7"] | None = None

    def __len__(self) -> int:
        return self.means.shape[1]

    def importance(self) -> Float[Tensor, " N"]:
        """Largest opacity over time times the area of the two longest axes, square metres."""
        two = self.log_scales.sort(-1).values[..., 1:].sum(-1)
        return (self.rgba[..., 3] * two.exp()).amax(0)

    def only(self, rows: Tensor) -> Track:
        """These Gaussians."""
        return replace(
            self, means=self.means[:, rows], quats=self.quats[:, rows],
            log_scales=self.log_scales[:, rows], rgba=self.rgba[:, rows],
        )  # fmt: skip

    def every(self, stride: int) -> Track:
        """Every stride-th key, and the last, of a moving entity; the others are not changed."""
        keys = len(self.means)
        if self.motion != "moving" or stride == 1:
            return self
        kept = key_frames(keys, stride)
        return replace(
            self, means=self.means[kept], quats=self.quats[kept],
            log_scales=self.log_scales[kept], rgba=self.rgba[kept],
        )  # fmt: skip


def key_frames(frames: int, stride: int) -> list[int]:
    """Every stride-th frame, and the last."""
    return sorted({*range(0, frames, stride), frames - 1})


def track_of(
    name: str,
    frames: Sequence[Gaussians],
    eyes: Sequence[Float[Tensor, " 3"]],
    rigid: bool = True,
) -> Track:
    """The track of an entity from its Gaussians in every frame.

    Args:
        eyes: camera centres, world; colours are the mean of what they see, as a track stores none
            that depends on the direction. rigid: whether poses may stand for the motion.
    """
    means = torch.stack([g.means for g in frames])
    quats = _continuous(torch.stack([normalize_quats(g.quats) for g in frames]))
    scales = torch.stack([g.log_scales for g in frames])
    rgba = torch.stack([rgba_of(g, eyes) for g in frames])
    whole = Track(name, "moving", means, quats, scales, rgba)
    if not len(whole):
        return whole
    own = torch.stack([g.colors for g in frames])  # what the light changes, not the direction
    if any(float((x - x[:1]).abs().max()) >= STEADY for x in (scales, rgba[..., 3], own)):
        return whole
    middle = len(frames) // 2
    one = replace(
        whole, motion="static", means=means[:1], quats=quats[:1], log_scales=scales[:1],
        rgba=rgba[middle : middle + 1],
    )  # fmt: skip
    if float((means - means[:1]).norm(dim=-1).max()) < STILL_M:
        return one
    if not rigid or len(whole) < 3:
        return whole
    poses = torch.stack([pose_of(means[0], m) for m in means])
    left = [remaining(means[0], quats[0], m, q, p) for m, q, p in zip(means, quats, poses)]
    if max(left) > RIGID_M:
        return whole
    return replace(one, motion="rigid", poses=poses)


def rgba_of(gaussians: Gaussians, eyes: Sequence[Float[Tensor, " 3"]]) -> Float[Tensor, "N 4"]:
    """Colour, the mean of what these camera centres see, and opacity."""
    color = mean_colors(gaussians.sh, gaussians.means, eyes)
    return torch.cat((color, gaussians.opacities[:, None]), -1)


def _continuous(quats: Float[Tensor, "K N 4"]) -> Float[Tensor, "K N 4"]:
    """The same rotations, with the sign nearer to that of the key before."""
    signs = torch.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)
    signs = torch.cat((torch.ones_like(quats[:1, :, 0]), signs)).cumprod(0)
    return quats * signs[..., None]


def pose_of(source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"]) -> Float[Tensor, " 7"]:
    """Rotation (quaternion) and translation that take the source to the target."""
    rotation = kabsch(source.double(), target.double())
    shift = target.double().mean(0) - rotation @ source.double().mean(0)
    return torch.cat((matrices_to_quats(rotation), shift)).float()


def remaining(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    moved: Float[Tensor, "N 3"],
    turned: Float[Tensor, "N 4"],
    pose: Float[Tensor, " 7"],
) -> float:
    """Percentile 99 of the distance between a rigid motion and the true one, metres.

    A rotation that differs by more than 2 degrees counts as 1 m.
    """
    rotated = means @ quats_to_matrices(pose[:4]).mT + pose[4:]
    apart = (rotated - moved).norm(dim=-1)
    dot = (multiply_quats(pose[:4].expand_as(quats), quats) * turned).sum(-1).abs()
    worst = float(torch.quantile(apart[:: len(apart) // 100_000 + 1], 0.99))
    return worst if float(dot.median()) > 0.99985 else 1.0
