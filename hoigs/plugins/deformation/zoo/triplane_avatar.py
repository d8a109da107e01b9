"""deformation:triplane-avatar: the humans of ExAvatar (Moon et al. 2024, arXiv:2407.21686) and HUGS
(Kocabas et al. 2024, arXiv:2311.17910): one class, whose settings tell them apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.interfaces.body import LEFT_HAND_PART, PELVIS, RIGHT_HAND_PART
from hoigs.core.maths.feature_planes import axis_pairs, sample_planes
from hoigs.core.maths.nearest import nearest, neighbours_of, point_roughness
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.core.maths.skinning import skin_quats
from hoigs.core.parameters import zeroed
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.human_planes import CanonicalAttributes
from hoigs.plugins.deformation.skinned_body import SkinnedBodyConfig
from hoigs.plugins.deformation.surface_body import OPAQUE, SurfaceBody

# Decoders from a canonical point's features to its Gaussian (ExAvatar, Moon et al. 2024,
# arXiv:2407.21686; HUGS, Kocabas et al. 2024, arXiv:2311.17910), and their 6D rotations.

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
        features: width of the input. width, depth, kind: those of each trunk.
        shape: "isotropic" is one scale and no rotation (ExAvatar), "full" three scales and a 6D
            rotation (HUGS).
        opacity: learn opacities. joints: number of learned skinning weights; None keeps the
            body's.
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


CANDIDATES = 16  # vertices near a canonical point; offsets of centimetres do not leave them


class TriplaneAvatarConfig(SkinnedBodyConfig):
    """ExAvatar's human by default; HUGS's by other settings (specs/hugs.yaml)."""

    resolution: int = Field(default=128, ge=2)
    """Cells along each side of the three planes."""
    channels: int = Field(default=32, ge=1)
    """Channels of each plane."""
    box: float = Field(default=2.0, gt=0)
    """Side of the cube that the planes cover, metres."""
    width: int = Field(default=128, ge=8, multiple_of=4)
    """Width of the hidden layers of each decoder."""
    depth: int = Field(default=3, ge=1)
    """Hidden layers of each decoder."""
    decoder: Decoder = "group-norm"
    """Normalisation and activation of a layer: "group-norm" with ReLU, or "gelu" alone."""
    shape: Shape = "isotropic"
    """"isotropic" is one scale and no rotation, "full" three scales and a 6D rotation."""
    opacity: Literal["one", "learned"] = "one"
    """Opacity of every Gaussian: fixed at "one", or "learned"."""
    skinning: Literal["nearest", "template", "learned"] = "nearest"
    """Weights of the "nearest" vertex to where the offset moved the point (hands keep their own),
    of the "template" where the point was, or "learned" from the planes."""
    pose_dependent: bool = True
    """A second offset, scale and colour that depend on the body's pose (ExAvatar)."""
    free_points: bool = False
    """Train the points at which the planes are read, too, which density control can then multiply
    (HUGS); else the points are the body's."""
    hand_stiffness: float = Field(default=100.0, ge=1)
    """Factor of the penalties of offsets and scales on hands."""
    refine_shape: bool = True
    """Learn one correction of shape, where poses are refined."""


@dataclass(frozen=True)
class _Predicted:
    """What the last training pass predicted, for `regularizers`; of the canonical decoders first,
    then of those that depend on the pose."""

    offsets: list[Tensor]
    scales: list[Tensor]
    template_scales: Tensor
    colors: list[Tensor]
    weights: Tensor


class TriplaneAvatar(SurfaceBody):
    """G(t) = LBS(P + dP(f) + dP'(f, theta), theta, W), f the planes' features at P.

    Colours are (tanh(c) + 1) / 2, so that zero is grey. Whatever is learned starts where it changes
    nothing: the avatar starts as its skinned grey template. The pose enters without gradient, as in
    ExAvatar. For the arguments besides the config see SkinnedBody.
    """

    Config: ClassVar = TriplaneAvatarConfig
    rates: ClassVar[Mapping[str, str]] = {"planes": "planes", **SurfaceBody.rates}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "offset": 10.0,
        "scale": 1.0,
        "laplacian": 10.0,
        "skinning": 1000.0,
    }
    transient: ClassVar[Mapping[str, Any]] = {"_predicted": None}

    cut_gradients = frozenset({"refinement.pose"})  # the pose decoders read a detached pose

    neighbours: Tensor | None
    candidates: Tensor | None

    def _build(self) -> None:
        config = self.config
        if self.refinement is not None:
            self.refinement.betas.requires_grad_(config.refine_shape)
        self.half_box = config.box / 2
        # ExAvatar's planes start at zero; below last layers of zeros they would then learn nothing
        size = (3, config.resolution, config.resolution, config.channels)
        self.planes = nn.Parameter(torch.randn(size) * 0.1)
        trunk = (3 * config.channels, config.width, config.depth, config.decoder)
        joints = len(self.body.parents) if config.skinning == "learned" else None
        self.canonical = CanonicalDecoders(
            *trunk, config.shape, config.opacity == "learned", joints
        )
        self.posing = PoseDecoders(*trunk) if config.pose_dependent else None
        owned = {"quats", "log_scales", "opacity_logits", "sh"}
        self.owns = frozenset(owned if config.free_points else owned | {"means"})
        # an offset that follows the pose may move a point from one nearest vertex to the next
        self.continuous = not (config.pose_dependent and config.skinning == "nearest")
        self._predicted: _Predicted | None = None

    def bind(self, canonical: Gaussians) -> None:
        super().bind(canonical)
        self.register_buffer("neighbours", neighbours_of(canonical.means), persistent=False)
        found = None
        if self.config.skinning == "nearest":
            found = nearest(canonical.means, CANDIDATES, self.rest_vertices)[0]
        # stored in checkpoints, as rows that were added later do not lie where they were bound
        self.register_buffer("candidates", found)

    def features(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N F"]:
        """The three planes' values at canonical points, concatenated."""
        places = (points - self.rest_joints[PELVIS]) / self.half_box
        return sample_planes(self.planes, axis_pairs(places))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        pose, vertices, joints = self.shaped_pose(moment, residual)
        features = self.features(canonical.means)
        base = self.canonical(features)
        offsets, scales = [base.offsets], [base.log_scales]
        theta = matrices_to_6d(axis_angle_to_matrices(pose.body.detach())).flatten()
        if self.posing is not None:
            offset, scale = self.posing.shape(features, theta)
            offsets.append(offset * (~self._hands())[:, None])
            scales.append(scale.expand(-1, 3))
        change = self.shape_change(pose, vertices, moment)
        means = canonical.means + torch.stack(offsets).sum(0)
        weights = self.weights(means, base)
        log_scales = canonical.log_scales + torch.stack(scales).sum(0)
        decoded = canonical.replace(
            means=means if change is None else means + change,
            quats=self._quats(canonical, base),
            log_scales=log_scales,
            opacity_logits=self._opacity(canonical, base),
        )
        out = self.posed(decoded, weights, pose, joints, moment, residual)
        colors = [base.colors]
        if self.posing is not None:
            normals = self._normals(weights, pose)
            colors.append(self.posing.colors(features, theta, normals))
        squashed = 0.5 * torch.stack(colors).sum(0).tanh() / SH_C0
        bands = canonical.sh.shape[1]
        if self.training and torch.is_grad_enabled():
            self._predicted = _Predicted(
                offsets, scales, canonical.log_scales.detach(), colors, weights
            )
        return out.replace(sh=nn.functional.pad(squashed[:, None], (0, 0, 0, bands - 1)))

    def weights(
        self, means: Float[Tensor, "N 3"], base: CanonicalAttributes
    ) -> Float[Tensor, "N J"]:
        """Skinning weights of points at `means` in the zero pose; rows sum to one."""
        if base.weights is not None:
            return ((self.template_weights + 1e-6).log() + base.weights).softmax(-1)
        if self.candidates is None:
            return self.template_weights
        with torch.no_grad():
            squared = (self.rest_vertices[self.candidates] - means[:, None]).square().sum(-1)
            vertex = self.candidates.gather(1, squared.argmin(1, keepdim=True)).squeeze(1)
            found = self.body.skinning_weights[vertex]
            return torch.where(self._hands()[:, None], self.template_weights, found)

    def peak_opacity_logits(self, canonical: Gaussians) -> Float[Tensor, " N"]:
        if self.config.opacity == "one":
            return torch.full_like(canonical.opacity_logits, OPAQUE)
        with torch.no_grad():
            base: CanonicalAttributes = self.canonical(self.features(canonical.means))
        return self._opacity(canonical, base)

    def _hands(self) -> Tensor:
        return (self.parts == LEFT_HAND_PART) | (self.parts == RIGHT_HAND_PART)

    def _opacity(self, canonical: Gaussians, base: CanonicalAttributes) -> Tensor:
        if base.opacity_logits is None:
            return torch.full_like(canonical.opacity_logits, OPAQUE)
        return canonical.opacity_logits + base.opacity_logits

    def _quats(self, canonical: Gaussians, base: CanonicalAttributes) -> Tensor:
        quats = canonical.quats
        return normalize_quats(quats if base.quats is None else multiply_quats(base.quats, quats))

    @torch.no_grad()
    def _normals(self, weights: Tensor, pose: BodyPose) -> Float[Tensor, "N 3"]:
        """The template's normals in the world, turned by the skinning."""
        transforms = self.body.skinning_transforms(pose)
        turns = skin_quats(transforms, weights, self.body.parents, self.ancestors)
        return (quats_to_matrices(turns) @ self.normals[..., None]).squeeze(-1)

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        if self.candidates is not None:
            self.candidates = self.candidates[change.source].contiguous()
        self.neighbours = self._predicted = None

    def regularizers(self) -> dict[str, Tensor]:
        """Penalties of the last training pass; means over points and coordinates.

        "offset": squared offsets, m^2, and "scale": squared scales, m^2, plus the squares of what
        the pose adds to their logarithms; hands count `hand_stiffness` times (ExAvatar).
        "laplacian", "laplacian_scale", "laplacian_color": offset, scale and colour against the
        mean of the nearest points. "skinning": learned weights against the body's (HUGS).
        """
        last, self._predicted = self._predicted, None  # its graph is freed with this step's
        if last is None:
            return {}
        stiff = 1 + (self.config.hand_stiffness - 1) * self._hands().to(last.weights)[:, None]
        grown = (last.template_scales + last.scales[0]).exp()
        squares = [x.square() for x in (grown, *last.scales[1:])]
        penalties = {
            "offset": (stiff * torch.stack(last.offsets).square().sum(0)).mean(),
            "scale": (stiff * torch.stack(squares).sum(0)).mean(),
        }
        if self.config.skinning == "learned":
            penalties["skinning"] = (last.weights - self.template_weights).square().mean()
        if self.neighbours is not None:
            penalties |= self._roughness(last, self.neighbours)
        return penalties

    def _roughness(self, last: _Predicted, neighbours: Int[Tensor, "N k"]) -> dict[str, Tensor]:
        """The Laplacian penalties of the canonical avatar plus those of the pose-dependent one."""
        both = lambda parts: parts[:1] if len(parts) == 1 else [parts[0], sum(parts)]  # noqa: E731
        typical = last.template_scales.mean()  # the template's own variation is not roughness
        groups = {
            "laplacian": both(last.offsets),
            "laplacian_scale": [(typical + x).exp() for x in both(last.scales)],
            "laplacian_color": [(x.tanh() + 1) / 2 for x in both(last.colors)],
        }
        return {
            name: torch.stack([point_roughness(x, neighbours) for x in values]).sum() / 3
            for name, values in groups.items()
        }
