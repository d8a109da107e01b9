"""Decoders from a canonical point's features to its Gaussian (ExAvatar, Moon et al. 2024,
arXiv:2407.21686; HUGS, Kocabas et al. 2024, arXiv:2311.17910), and their 6D rotations."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.maths.networks import zeroed
from hoigs.core.maths.rotations import matrices_to_quats
from hoigs.plugins.deformation.avatars.canonical_head import CanonicalAttributes

Decoder = Literal["group-norm", "gelu"]
Shape = Literal["isotropic", "full"]

BODY_JOINTS = 21
POSE_WIDTH = 6 * BODY_JOINTS
GROUPS = 4


def matrices_to_6d(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """The first two rows of rotation matrices (Zhou et al. 2019, arXiv:1812.07035)."""
    return matrices[..., :2, :].flatten(-2)


def quats_of_6d(values: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of 6D rotations: two rows, made orthonormal, and their cross product."""
    first = nn.functional.normalize(values[..., :3], dim=-1)
    second = values[..., 3:] - (first * values[..., 3:]).sum(-1, keepdim=True) * first
    second = nn.functional.normalize(second, dim=-1)
    rows = (first, second, torch.linalg.cross(first, second))
    return matrices_to_quats(torch.stack(rows, dim=-2))


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
            shared: further inputs, the same for all rows, at the cost of one row.
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


def head(width: int, size: int) -> nn.Linear:
    """A last layer that starts at zero, so that the avatar starts as its template."""
    return zeroed(nn.Linear(width, size))


class CanonicalDecoders(nn.Module):
    """Geometry, appearance and optionally skinning: a trunk and its heads for each.

    Args:
        features: width of the input. width, depth, kind: of each trunk.
        shape: "isotropic" is one scale and no rotation (ExAvatar), "full" three scales and a 6D
            rotation (HUGS).
        opacity: learn opacities. joints: of learned skinning weights; None keeps the body's.
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
        self.offset = head(width, 3)
        self.scale = head(width, 1 if shape == "isotropic" else 3)
        self.rotation = head(width, 6) if shape == "full" else None
        self.appearance = Trunk(features, width, depth, kind)
        self.color = head(width, 3)
        self.opacity = head(width, 1) if opacity else None
        self.skinning: nn.Sequential | None = None
        if joints is not None:
            self.skinning = nn.Sequential(Trunk(features, width, depth, kind), head(width, joints))

    def forward(self, features: Float[Tensor, "N F"]) -> CanonicalAttributes:
        geometry, appearance = self.geometry(features), self.appearance(features)
        quats = None
        if self.rotation is not None:
            identity = features.new_tensor((1.0, 0, 0, 0, 1, 0))
            quats = quats_of_6d(identity + self.rotation(geometry))
        return CanonicalAttributes(
            offsets=0.1 * self.offset(geometry),  # in units of 10 cm, as CanonicalHead
            log_scales=self.scale(geometry).expand(-1, 3),
            colors=self.color(appearance),
            quats=quats,
            opacity_logits=None if self.opacity is None else self.opacity(appearance).squeeze(-1),
            weights=None if self.skinning is None else self.skinning(features),
        )


class PoseDecoders(nn.Module):
    """What depends on the pose (ExAvatar): offset, scale, and colour, which reads normals too.

    Args:
        features, width, depth, kind: as CanonicalDecoders.
    """

    def __init__(self, features: int, width: int, depth: int, kind: Decoder) -> None:
        super().__init__()
        self.geometry = Trunk(features + POSE_WIDTH, width, depth, kind)
        self.offset, self.scale = head(width, 3), head(width, 1)
        self.appearance = Trunk(features + POSE_WIDTH + 3, width, depth, kind)
        self.color = head(width, 3)

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
        """Additions to the colour before it is squashed; normals are in the world."""
        return self.color(self.appearance(torch.cat((features, normals), dim=1), pose))
