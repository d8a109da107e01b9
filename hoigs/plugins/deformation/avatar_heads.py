"""Decoders from a canonical point's features to its Gaussian (ExAvatar, Moon et al. 2024; HUGS,
Kocabas et al. 2024), and the 6D rotations that they read and give."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.rotation import matrices_to_quats

Decoder = Literal["group-norm", "gelu"]
Shape = Literal["isotropic", "full"]

BODY_JOINTS = 21
POSE_WIDTH = 6 * BODY_JOINTS
GROUPS = 4


def matrices_to_6d(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The first two rows of rotation matrices (Zhou et al. 2019)."""
    return matrices[..., :2, :].flatten(-2)


def quats_of_6d(values: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of 6D rotations: two rows, orthonormalised, and their cross product."""
    first = nn.functional.normalize(values[..., :3], dim=-1)
    second = values[..., 3:] - (first * values[..., 3:]).sum(-1, keepdim=True) * first
    second = nn.functional.normalize(second, dim=-1)
    rows = (first, second, torch.linalg.cross(first, second))
    return matrices_to_quats(torch.stack(rows, dim=-2))


@dataclass(frozen=True)
class AvatarGaussians:
    """What the decoders say of N canonical points.

    Attributes:
        offsets: metres. log_scales: added to the template's. colors: before their squashing.
        quats: unit rotations, None for none. opacity_logits: added to the raw ones, None for
            opaque.
        weights: added to the logarithm of the template's skinning weights; None leaves these.
    """

    offsets: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"] | None
    opacity_logits: Float[Tensor, " N"] | None
    weights: Float[Tensor, "N J"] | None


class Trunk(nn.Module):
    """`depth` layers of `width`: Linear, GroupNorm, ReLU (ExAvatar), or Linear, GELU (HUGS)."""

    def __init__(self, entry: int, width: int, depth: int, kind: Decoder) -> None:
        super().__init__()
        self.linears = nn.ModuleList(
            nn.Linear(size, width) for size in [entry] + [width] * (depth - 1)
        )
        normed = kind == "group-norm"
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, width) for _ in range(depth * normed))

    def forward(
        self, entry: Float[Tensor, "N E"], shared: Float[Tensor, " S"] | None = None
    ) -> Float[Tensor, "N W"]:
        """
        Args:
            shared: further inputs, the same for all rows; they cost as much as one row.
        """
        first = self.linears[0]
        assert isinstance(first, nn.Linear)
        own = entry.shape[1]
        bias: Tensor = first.bias
        if shared is not None:
            bias = bias + first.weight[:, own:] @ shared
        hidden = nn.functional.linear(entry, first.weight[:, :own], bias)
        for i in range(len(self.linears)):
            hidden = self.linears[i](hidden) if i else hidden
            hidden = self.norms[i](hidden).relu() if self.norms else nn.functional.gelu(hidden)
        return hidden


def quiet(width: int, size: int) -> nn.Linear:
    """A last layer that starts at zero, so that the avatar starts as its template."""
    layer = nn.Linear(width, size)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class CanonicalDecoders(nn.Module):
    """Geometry, appearance and, where asked for, skinning: a trunk and heads for each.

    Args:
        features: width of the input. width, depth, kind: of each trunk.
        shape: "isotropic" is one scale and no rotation (ExAvatar), "full" three and 6D (HUGS).
        opacity: learn opacities. joints: of learned skinning weights; None leaves the template's.
    """

    def __init__(
        self,
        features: int,
        width: int,
        depth: int,
        kind: Decoder,
        shape: Shape,
        opacity: bool,
        joints: int | None,
    ) -> None:
        super().__init__()
        self.geometry = Trunk(features, width, depth, kind)
        self.offset = quiet(width, 3)
        self.scale = quiet(width, 1 if shape == "isotropic" else 3)
        self.rotation = quiet(width, 6) if shape == "full" else None
        self.appearance = Trunk(features, width, depth, kind)
        self.color = quiet(width, 3)
        self.opacity = quiet(width, 1) if opacity else None
        self.skinning: nn.Sequential | None = None
        if joints is not None:
            self.skinning = nn.Sequential(Trunk(features, width, depth, kind), quiet(width, joints))

    def forward(self, features: Float[Tensor, "N F"]) -> AvatarGaussians:
        shape, looks = self.geometry(features), self.appearance(features)
        quats = None
        if self.rotation is not None:
            identity = features.new_tensor((1.0, 0, 0, 0, 1, 0))
            quats = quats_of_6d(identity + self.rotation(shape))
        return AvatarGaussians(
            offsets=0.1 * self.offset(shape),  # units of 10 cm, or colours' rates fling the points
            log_scales=self.scale(shape).expand(-1, 3),
            colors=self.color(looks),
            quats=quats,
            opacity_logits=None if self.opacity is None else self.opacity(looks).squeeze(-1),
            weights=None if self.skinning is None else self.skinning(features),
        )


class PoseDecoders(nn.Module):
    """What depends on the body's pose: offset and scale, and colour, which sees normals too.

    Args:
        features, width, depth, kind: as CanonicalDecoders.
    """

    def __init__(self, features: int, width: int, depth: int, kind: Decoder) -> None:
        super().__init__()
        self.geometry = Trunk(features + POSE_WIDTH, width, depth, kind)
        self.offset, self.scale = quiet(width, 3), quiet(width, 1)
        self.appearance = Trunk(features + POSE_WIDTH + 3, width, depth, kind)
        self.color = quiet(width, 3)

    def shape(
        self, features: Float[Tensor, "N F"], pose: Float[Tensor, " P"]
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 1"]]:
        """Offsets, metres, and additions to the logarithm of the scale."""
        hidden = self.geometry(features, pose)
        return 0.1 * self.offset(hidden), self.scale(hidden)

    def colors(
        self,
        features: Float[Tensor, "N F"],
        pose: Float[Tensor, " P"],
        normals: Float[Tensor, "N 3"],
    ) -> Float[Tensor, "N 3"]:
        """Additions to the colour before its squashing; normals are of the world."""
        return self.color(self.appearance(torch.cat((features, normals), dim=1), pose))
