"""deformation:triplane-avatar: the humans of ExAvatar (Moon et al. 2024) and HUGS (Kocabas et al.
2024), methods B.5 and B.6: one part, whose settings tell them apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.body import PELVIS, BodyModel
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.gaussians import SH_C0, Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import BodyPose, Moment
from hoigs.core.planes import axis_pairs, sample_planes
from hoigs.core.rotation import axis_angle_to_matrices, multiply_quats, quats_to_matrices
from hoigs.core.topology import TopologyChange
from hoigs.plugins.deformation.avatar_heads import (
    AvatarGaussians,
    CanonicalDecoders,
    Decoder,
    PoseDecoders,
    Shape,
    matrices_to_6d,
)
from hoigs.plugins.deformation.skinned_body import context_settings
from hoigs.plugins.deformation.skinning import skin_quats
from hoigs.plugins.deformation.surface_body import SurfaceBody
from hoigs.plugins.deformation.surface_laplacian import nearest, point_roughness

Skinning = Literal["nearest", "template", "learned"]
Opacity = Literal["one", "learned"]

OPAQUE = 4.6  # logit of 0.99, the most that rasterizers let through
HANDS = (8, 9)
CANDIDATES = 16  # vertices about a point at rest; offsets of centimetres do not leave them


class TriplaneAvatarConfig(ComponentConfig):
    """ExAvatar's human by default; HUGS's by other settings (specs/hugs.yaml).

    Attributes:
        resolution, channels: of the three planes. box: side of their cube, metres.
        width, depth: hidden layers of each decoder. decoder: "group-norm" with ReLU, or "gelu".
        shape: "isotropic" is one scale and no rotation, "full" three scales and a 6D rotation.
        opacity: "one", or "learned".
        skinning: weights of the "nearest" vertex to where the offset took the point (hands keep
            their own), of the "template" where the point was, or "learned" from the planes.
        pose_dependent: a second offset, scale and colour that see the body's pose (ExAvatar).
        free_points: train the places at which the planes are read too, which density control can
            then multiply (HUGS); else the points are the body's.
        hand_stiffness: by how much more offsets and scales are held back on hands.
        refine_poses: learn per-frame corrections of pose and translation.
        refine_shape: learn one correction of shape.
    """

    resolution: int = Field(128, ge=2)
    channels: int = Field(32, ge=1)
    box: float = Field(2.0, gt=0)
    width: int = Field(128, ge=8, multiple_of=4)
    depth: int = Field(3, ge=1)
    decoder: Decoder = "group-norm"
    shape: Shape = "isotropic"
    opacity: Opacity = "one"
    skinning: Skinning = "nearest"
    pose_dependent: bool = True
    free_points: bool = False
    hand_stiffness: float = Field(100.0, ge=1)
    refine_poses: bool = True
    refine_shape: bool = True


@dataclass(frozen=True)
class _Seen:
    """What the last training pass said of the points, for `regularizers`."""

    offsets: list[Tensor]
    scales: list[Tensor]
    template_scales: Tensor
    colors: list[Tensor]
    weights: Tensor


class TriplaneAvatar(SurfaceBody):
    """G(t) = LBS(P + dP(f) + dP'(f, theta), theta, W), f the planes' features at P.

    Colours are (tanh(c) + 1) / 2, so that the last layer's zero is grey. Whatever is learned starts
    where it changes nothing: the avatar starts as its skinned grey template. The pose enters
    without gradient, as in ExAvatar.

    Args:
        body: as SkinnedBody. The others are SurfaceBody's and TriplaneAvatarConfig's.
    """

    rates: ClassVar[Mapping[str, str]] = {"planes": "planes", **SurfaceBody.rates}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "offset": 10.0,
        "scale": 1.0,
        "laplacian": 10.0,
        "skinning": 1000.0,
    }

    cut_gradients = frozenset({"refinement.pose"})  # the posing decoders see a detached pose

    neighbours: Tensor | None
    candidates: Tensor | None

    def __init__(
        self,
        body: BodyModel,
        *,
        resolution: int = 128,
        channels: int = 32,
        box: float = 2.0,
        width: int = 128,
        depth: int = 3,
        decoder: Decoder = "group-norm",
        shape: Shape = "isotropic",
        opacity: Opacity = "one",
        skinning: Skinning = "nearest",
        pose_dependent: bool = True,
        free_points: bool = False,
        hand_stiffness: float = 100.0,
        refine_poses: bool = False,
        refine_shape: bool = True,
        **surface: Any,
    ) -> None:
        super().__init__(body, refine_poses=refine_poses, **surface)
        if self.refinement is not None:
            self.refinement.betas.requires_grad_(refine_shape)
        self.half_box, self.hand_stiffness = box / 2, hand_stiffness
        self.opacity, self.skinning, self.shape = opacity, skinning, shape
        # ExAvatar's start at zero; under last layers of zeros they would wait for these
        self.planes = nn.Parameter(torch.randn(3, resolution, resolution, channels) * 0.1)
        joints = len(body.parents) if skinning == "learned" else None
        features = 3 * channels
        self.canonical = CanonicalDecoders(
            features, width, depth, decoder, shape, opacity == "learned", joints
        )
        self.posing: PoseDecoders | None = None
        if pose_dependent:
            self.posing = PoseDecoders(features, width, depth, decoder)
        owned = {"quats", "log_scales", "opacity_logits", "sh"}
        self.owns = frozenset(owned if free_points else owned | {"means"})
        # an offset that follows the pose may carry a point from one nearest vertex to the next
        self.continuous = not (pose_dependent and skinning == "nearest")
        self._seen: _Seen | None = None

    @classmethod
    def from_config(cls, config: TriplaneAvatarConfig, context: BuildContext) -> Self:
        settings = context_settings(context, "deformation:triplane-avatar")
        settings.pop("camera_centers", None)  # it scales about the pelvis
        assert context.body is not None
        return cls(context.body, **settings, **config.model_dump())

    def bind(self, rest: Gaussians) -> None:
        super().bind(rest)
        means = rest.means.detach()
        self.register_buffer("neighbours", nearest(means), persistent=False)
        found = near_vertices(means, self.rest_vertices) if self.skinning == "nearest" else None
        # saved, as rows that have come since cannot tell where they were bound
        self.register_buffer("candidates", found)

    def features(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N F"]:
        """The three planes' values at canonical points, concatenated."""
        places = (points - self.rest_joints[PELVIS]) / self.half_box
        return sample_planes(self.planes, axis_pairs(places))

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        pose = self.moved_pose(moment, residual)
        features = self.features(rest.means)
        base = self.canonical(features)
        offsets, scales = [base.offsets], [base.log_scales]
        theta = matrices_to_6d(axis_angle_to_matrices(pose.body.detach())).flatten()
        if self.posing is not None:
            offset, scale = self.posing.shape(features, theta)
            offsets.append(offset * (~self._hands())[:, None])
            scales.append(scale.expand(-1, 3))
        change = self.shape_change(pose, moment)
        means = rest.means + torch.stack(offsets).sum(0)
        weights = self.weights(means, base)
        log_scales = rest.log_scales + torch.stack(scales).sum(0)
        canonical = rest.replace(
            means=means if change is None else means + change,
            quats=self._quats(rest, base),
            log_scales=log_scales,
            opacity_logits=self._opacity(rest, base),
        )
        out = self.posed(canonical, weights, pose, moment, residual)
        colors = [base.colors]
        if self.posing is not None:
            normals = self._normals(weights, pose)
            colors.append(self.posing.colors(features, theta, normals))
        squashed = 0.5 * torch.stack(colors).sum(0).tanh() / SH_C0
        bands = rest.sh.shape[1]
        if self.training and torch.is_grad_enabled():
            self._seen = _Seen(offsets, scales, rest.log_scales.detach(), colors, weights)
        return out.replace(sh=nn.functional.pad(squashed[:, None], (0, 0, 0, bands - 1)))

    def weights(self, means: Float[Tensor, "N 3"], base: AvatarGaussians) -> Float[Tensor, "N J"]:
        """Skinning weights of points that stand at `means` in the zero pose; rows sum to one."""
        if base.weights is not None:
            return ((self.template_weights + 1e-6).log() + base.weights).softmax(-1)
        if self.candidates is None:
            return self.template_weights
        with torch.no_grad():
            apart = (self.rest_vertices[self.candidates] - means[:, None]).square().sum(-1)
            vertex = self.candidates.gather(1, apart.argmin(1, keepdim=True)).squeeze(1)
            theirs = self.body.skinning_weights[vertex]
            return torch.where(self._hands()[:, None], self.template_weights, theirs)

    def peak_opacity_logits(self, rest: Gaussians) -> Float[Tensor, " N"]:
        if self.opacity == "one":
            return torch.full_like(rest.opacity_logits, OPAQUE)
        with torch.no_grad():
            base: AvatarGaussians = self.canonical(self.features(rest.means))
        return self._opacity(rest, base)

    def _hands(self) -> Tensor:
        return (self.parts == HANDS[0]) | (self.parts == HANDS[1])

    def _opacity(self, rest: Gaussians, base: AvatarGaussians) -> Tensor:
        if base.opacity_logits is None:
            return torch.full_like(rest.opacity_logits, OPAQUE)
        return rest.opacity_logits + base.opacity_logits

    def _quats(self, rest: Gaussians, base: AvatarGaussians) -> Tensor:
        return rest.quats if base.quats is None else multiply_quats(base.quats, rest.quats)

    @torch.no_grad()
    def _normals(self, weights: Tensor, pose: BodyPose) -> Float[Tensor, "N 3"]:
        """The template's normals, turned with the skin into the world."""
        transforms = self.body.skinning_transforms(pose)
        turns = skin_quats(weights, transforms, self.body.parents, self.ancestors)
        return (quats_to_matrices(turns) @ self.normals[..., None]).squeeze(-1)

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        if self.candidates is not None:
            self.candidates = self.candidates[change.source].contiguous()
        self.neighbours = self._seen = None

    def regularizers(self) -> dict[str, Tensor]:
        """Of the last training pass; means over points and coordinates.

        "offset": squared offsets, m^2, and "scale": squared scales, m^2, with the squares of what
        the pose adds to their logarithms; hands count `hand_stiffness` times (ExAvatar).
        "laplacian", "laplacian_scale", "laplacian_color": offset, scale and colour against the
        mean of the nearest points'. "skinning": learned weights against the template's (HUGS).
        """
        seen = self._seen
        if seen is None:
            return {}
        self._seen = None  # its graph is used up with this step's
        stiff = 1 + (self.hand_stiffness - 1) * self._hands().to(seen.weights)[:, None]
        grown = (seen.template_scales + seen.scales[0]).exp()
        squares = [x.square() for x in (grown, *seen.scales[1:])]
        penalties = {
            "offset": (stiff * torch.stack(seen.offsets).square().sum(0)).mean(),
            "scale": (stiff * torch.stack(squares).sum(0)).mean(),
        }
        if self.skinning == "learned":
            penalties["skinning"] = (seen.weights - self.template_weights).square().mean()
        if self.neighbours is not None:
            penalties |= self._roughness(seen, self.neighbours)
        return penalties

    def _roughness(self, seen: _Seen, neighbours: Int[Tensor, "N k"]) -> dict[str, Tensor]:
        """The Laplacian penalties, of the plain avatar plus of the pose-dependent one."""
        both = lambda parts: parts[:1] if len(parts) == 1 else [parts[0], sum(parts)]  # noqa: E731
        typical = seen.template_scales.mean()  # the template's own unevenness is no roughness
        groups = {
            "laplacian": both(seen.offsets),
            "laplacian_scale": [(typical + x).exp() for x in both(seen.scales)],
            "laplacian_color": [(x.tanh() + 1) / 2 for x in both(seen.colors)],
        }
        return {
            name: torch.stack([point_roughness(x, neighbours) for x in values]).sum() / 3
            for name, values in groups.items()
        }


def near_vertices(
    points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"]
) -> Int[Tensor, "N k"]:
    """The vertices nearest to each point, nearest first."""
    from scipy.spatial import cKDTree  # on use: scipy takes a while to import

    count = min(CANDIDATES, len(vertices))
    tree = cKDTree(vertices.detach().cpu().double().numpy())
    _, indices = tree.query(points.detach().cpu().double().numpy(), k=count)
    return torch.as_tensor(indices, dtype=torch.int64, device=points.device).reshape(-1, count)
