"""deformation:hexplane-skinning: HOIGS's human (Sec. "Human Deformation", methods A.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.body import PELVIS, BodyModel, BodySurface
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.gaussians import SH_C0, GaussianDelta, Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment, ResidualRule
from hoigs.core.rotation import multiply_quats
from hoigs.core.topology import TopologyChange
from hoigs.plugins.deformation.alpha_start import AlphaStart, depth_ratio
from hoigs.plugins.deformation.body_planes import Fusion, body_planes, field_subset
from hoigs.plugins.deformation.canonical_head import CanonicalAttributes, CanonicalHead, HeadKind
from hoigs.plugins.deformation.face_points import HEAD_JOINT, face_points
from hoigs.plugins.deformation.skinned_body import (
    ScaleAbout,
    SkinnedBody,
    checked_surface,
    context_settings,
)
from hoigs.plugins.deformation.skinning import skin_points, skin_quats
from hoigs.plugins.deformation.surface_laplacian import (
    LaplacianOn,
    Smoothed,
    laplacians,
    mesh_edges,
    nearest,
)

FieldAt = Literal["posed", "canonical"]

OPAQUE = 4.6  # logit of 0.99


class HexPlaneSkinningConfig(ComponentConfig):
    """The paper's human; sizes that it leaves open are ExAvatar's (methods A.4).

    Attributes:
        fusion: how six planes give 96. "paired" multiplies each space plane with the time plane
            of the other axis and concatenates the three (HexPlane's own fusion); by default, as it
            gives the time-invariant f, 3 x 32, and phi from the same planes. "product" multiplies
            all six, at three resolutions (4DGS, K-Planes).
        resolution, channels: of the feature planes. time_resolution: None is half the frames; 0 is
            no time planes, for a human that nothing describes over time.
        box: side of the cube about the pelvis that the planes cover, metres.
        width: of psi_h. head: what psi_h predicts, see CanonicalHead.
        free_attributes: train each point's own colour, opacity and scale too, which psi_h then
            adds to; they converge sooner. "all" trains its place and turn as well, so that it is
            no longer bound to the template's surface. False is the paper: all comes from the
            planes.
        refine_poses: learn per-frame corrections of pose and translation, and one of shape.
        scale_about: the fixed point of alpha, which the paper leaves open (the world's origin would
            carry the person off). "pelvis", the default, changes their size, which images can tell;
            the "camera" changes depth but not the image, so that only L_depth moves alpha.
        alpha_start: alpha at the start, "one", or the ratio of the clip's metric "depth" to the
            body's own, which suits the scale about the camera.
        field_points: body points at which phi is read, spread over the 16 parts.
        field_at: "posed" reads phi where the body is (the supplement's "dynamic coordinates",
            taken relative to the pelvis, as planes over the world would waste their cells);
            "canonical" on the body at rest, so that time alone changes a token.
        residual_rule: how delta theta joins theta: "add" axis-angles, as the paper prints it, or
            "compose" rotations, which differs for large angles.
        laplacian: L_reg of psi_h over neighbouring "points", the Gaussians, which costs nothing
            more; or over the vertices of the body's "mesh" (the paper): a second pass of psi_h, but
            its neighbours never reach from one thigh to the other.
        laplacian_of: what L_reg smooths: ExAvatar's "offset", "scale" and "color", or fewer.
    """

    fusion: Fusion = "paired"
    resolution: int = Field(128, ge=2)
    channels: int = Field(32, ge=1)
    time_resolution: int | None = Field(None, ge=0)
    box: float = Field(2.5, gt=0)
    width: int = Field(128, ge=8)
    head: HeadKind = "full"
    free_attributes: bool | Literal["all"] = True
    refine_poses: bool = True
    scale_about: ScaleAbout = "pelvis"
    alpha_start: AlphaStart = "one"
    field_points: int = Field(1536, ge=16)
    field_at: FieldAt = "posed"
    residual_rule: ResidualRule = "add"
    laplacian: LaplacianOn = "points"
    laplacian_of: tuple[Smoothed, ...] = ("offset",)


class HexPlaneSkinning(SkinnedBody):
    """G_human = alpha LBS(P_c, theta, W), with psi_h(f(T_c)) = (c, o, dP_c, R, S, W).

    The canonical body is the zero pose. f and phi come from the same paired planes: f is read at
    canonical points, phi at posed ones, both relative to the pelvis and before alpha. Everything
    that is learned starts where it changes nothing: the human starts as its skinned template.

    The rest Gaussians lie on `surface`, or, when none is given, on
    `body.surface(len(rest), betas, seed)`: rest must have been made with the same call.

    Args:
        body, entity, betas, num_frames, trained_frames, camera_centers: as SkinnedBody;
            num_frames also gives the default time resolution.
        surface: the points of rest, where they are not those of `body.surface`.
        seed: of that surface.
        The others are HexPlaneSkinningConfig's.
    """

    provides = frozenset({"field", "skeleton", "face"})
    recordable = True
    rates: ClassVar[Mapping[str, str]] = {
        "planes": "planes",
        "refinement": "pose",
        "refinement.betas": "shape",
        "log_alpha": "shape",
    }
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "offset": 1.0,
        "laplacian": 10.0,
        "laplacian_scale": 0.1,
        "laplacian_color": 0.1,
        "skinning": 1.0,
        "time_smoothness": 0.01,
        "time_sparsity": 1e-4,
    }

    field_vertices: Tensor
    log_weights: Tensor
    parts: Tensor
    faces: Tensor
    barycentric: Tensor
    neighbours: Tensor | None
    edges: Tensor | None

    def __init__(
        self,
        body: BodyModel,
        *,
        entity: str = "human",
        betas: Float[Tensor, " B"] | None = None,
        surface: BodySurface | None = None,
        seed: int = 0,
        num_frames: int | None = None,
        trained_frames: Sequence[int] | None = None,
        camera_centers: Float[Tensor, "F 3"] | None = None,
        fusion: Fusion = "paired",
        resolution: int = 128,
        channels: int = 32,
        time_resolution: int | None = None,
        box: float = 2.5,
        width: int = 128,
        head: HeadKind = "full",
        free_attributes: bool | Literal["all"] = True,
        refine_poses: bool = False,
        scale_about: ScaleAbout = "pelvis",
        field_points: int = 1536,
        field_at: FieldAt = "posed",
        residual_rule: ResidualRule = "add",
        laplacian: LaplacianOn = "points",
        laplacian_of: Sequence[Smoothed] = ("offset",),
    ) -> None:
        super().__init__(
            body,
            entity=entity,
            betas=betas,
            num_frames=num_frames,
            trained_frames=trained_frames,
            camera_centers=camera_centers,
            refine_poses=refine_poses,
            scale_about=scale_about,
        )
        self._surface = surface
        self.seed, self.half_box = seed, box / 2
        self.opaque = head == "exavatar"
        self.field_posed, self.residual_rule = field_at == "posed", residual_rule
        edges = mesh_edges(body.faces) if laplacian == "mesh" else None
        self.register_buffer("edges", edges, persistent=False)
        self.smoothed = tuple(laplacian_of)
        if time_resolution is None:
            time_resolution = max(8, (num_frames or 64) // 2)
        self.planes = body_planes(fusion, channels, resolution, time_resolution)
        self.head = CanonicalHead(self.planes.width, len(body.parents), width, head)
        owned: set[str] = set() if free_attributes == "all" else {"means", "quats"}
        owned |= {"opacity_logits"} if self.opaque else set()
        self.owns = frozenset(
            owned if free_attributes else {"means", "quats", "log_scales", "opacity_logits", "sh"}
        )
        field = field_subset(body.vertex_parts, field_points)
        self.register_buffer("field_vertices", field, persistent=False)
        self._cached: tuple[object, CanonicalAttributes, Tensor] | None = None
        self._last: tuple[CanonicalAttributes, Tensor] | None = None
        self._held: tuple[Gaussians, Tensor] | None = None

    @classmethod
    def from_config(cls, config: HexPlaneSkinningConfig, context: BuildContext) -> Self:
        settings = context_settings(context, "deformation:hexplane-skinning")
        settings |= config.model_dump(exclude={"alpha_start"})
        clip, track = context.clip, context.body_track
        assert context.body is not None
        made = cls(context.body, **settings)
        if config.alpha_start == "depth" and clip is not None and track is not None:
            ratio = depth_ratio(clip, context.entity, context.body, track)
            nn.init.constant_(made.log_alpha, math.log(ratio))
        return made

    def bind(self, rest: Gaussians) -> None:
        made = self._surface or self.body.surface(len(rest), self.betas, self.seed)
        surface = checked_surface(made, rest)
        for name, value in {
            "log_weights": (surface.weights + 1e-6).log(),
            "parts": surface.parts,
            "faces": surface.faces,
            "barycentric": surface.barycentric,
        }.items():
            self.register_buffer(name, value.detach().clone())
        self.register_buffer("neighbours", nearest(rest.means.detach()), persistent=False)
        self._surface = None

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        pose = self.pose(moment)
        vertices, joints = self.shaped(pose.betas, moment)
        if self._held is not None and self.held:
            canonical, weights = self._held
        else:
            attributes, weights = self._attributes(rest)
            canonical = self._canonical(
                rest, attributes, vertices, self.reshaped(pose.betas, moment)
            )
        if residual is not None and residual.pose is not None:
            pose = pose.with_residual(residual.pose, self.residual_rule)
        transforms = self.body.skinning_transforms(pose)
        means = skin_points(canonical.means, weights, transforms)
        pelvis = self.posed_joints(joints, transforms, (PELVIS,))[0]
        means = self.scaled(means, pelvis, moment)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        turns = skin_quats(weights, transforms, self.body.parents, self.ancestors)
        return replace(
            canonical,
            means=means,
            quats=multiply_quats(turns, canonical.quats),
            log_scales=canonical.log_scales + self.log_alpha,
        )

    @torch.no_grad()
    def hold(self, rest: Gaussians, moment: Moment) -> None:
        """As SkinnedBody, and the canonical Gaussians with it."""
        super().hold(rest, moment)
        pose = self.pose(moment)
        attributes, weights = self._attributes(rest)
        vertices = self.shaped(pose.betas, moment)[0]
        canonical = self._canonical(rest, attributes, vertices, reshaped=True)
        self._held = (canonical, weights)

    def _attributes(self, rest: Gaussians) -> tuple[CanonicalAttributes, Float[Tensor, "N J"]]:
        """psi_h of every canonical point, and its skinning weights. Neither depends on time, so
        they are kept between frames in eval mode (fused optimizers change parameters without a
        trace, hence not in training mode)."""
        keep = not self.training and not torch.is_grad_enabled()
        sources = (rest.means, self.log_weights, *self.planes.parameters(), *self.head.parameters())
        state = [(x.data_ptr(), x._version) for x in sources] if keep else []
        if keep and self._cached is not None and self._cached[0] == state:
            return self._cached[1], self._cached[2]
        points = (rest.means - self.rest_joints[PELVIS]) / self.half_box
        attributes = self.head(self.planes(points))
        logits = self.log_weights
        if attributes.weights is not None:
            logits = logits + attributes.weights
        weights = logits.softmax(-1)
        if self.training and torch.is_grad_enabled():
            self._remember(attributes, weights)
        elif keep:
            self._cached = (state, attributes, weights)
        return attributes, weights

    def train(self, mode: bool = True) -> Self:
        self._cached = self._held = None
        if not mode:
            self._last = None  # of a step; a copy of the model could not be made with its graph
        return super().train(mode)

    def _remember(self, attributes: CanonicalAttributes, weights: Tensor) -> None:
        """Keep the last forward's outputs for `regularizers`, until their graph is used up."""
        self._last = (attributes, weights)
        if attributes.offsets.requires_grad:

            def forget(gradient: Tensor) -> None:
                del gradient
                self._last = None

            attributes.offsets.register_hook(forget)

    def _canonical(
        self,
        rest: Gaussians,
        attributes: CanonicalAttributes,
        vertices: Float[Tensor, "V 3"],
        reshaped: bool,
    ) -> Gaussians:
        """Gaussians of the zero pose; of a body with these vertices, where it is reshaped."""
        offsets = attributes.offsets
        if reshaped:
            change = vertices - self.rest_vertices
            corners = change[self.body.faces[self.faces]]
            offsets = offsets + (corners * self.barycentric[..., None]).sum(1)
        bands = rest.sh.shape[1]
        canonical = rest.moved(
            GaussianDelta(
                means=offsets,
                quats=attributes.quats,
                log_scales=attributes.log_scales,
                opacity_logits=attributes.opacity_logits,
                sh=nn.functional.pad(attributes.colors[:, None] / SH_C0, (0, 0, 0, bands - 1)),
            )
        )
        if self.opaque:
            logits = torch.full_like(canonical.opacity_logits, OPAQUE)
            canonical = replace(canonical, opacity_logits=logits)
        return canonical

    def posed_field(
        self, rest: Gaussians, moment: Moment
    ) -> tuple[Float[Tensor, "V F"], Float[Tensor, "V 3"]]:
        """phi at the body, relative to its pelvis and before alpha, and its world places.

        The body points are vertices of the template, so every part is described however few
        Gaussians it has. Features have gradients in the planes alone, not in the pose: what moves
        the person is learned from images, not from where its features are read.
        """
        del rest
        with torch.no_grad():
            stance = self.stance(moment)
            points = stance.vertices.index_select(0, self.field_vertices)
            weights = self.body.skinning_weights.index_select(0, self.field_vertices)
            posed = skin_points(points, weights, stance.transforms)
            pelvis = self.posed_joints(stance.joints, stance.transforms, (PELVIS,))[0]
            places = self.scaled(posed, pelvis, moment)
        read = posed - pelvis if self.field_posed else points - self.rest_joints[PELVIS]
        return self.planes(read / self.half_box, moment.time), places

    def field_parts(self) -> Int[Tensor, " V"]:
        """Body part (0..15) of each point of `posed_field`."""
        return self.body.vertex_parts[self.field_vertices]

    @property
    def field_width(self) -> int:
        return self.planes.width

    def point_parts(self) -> Int[Tensor, " N"]:
        return self.parts

    def face_points(self) -> tuple[Int[Tensor, " F"], Float[Tensor, "F 3"]]:
        triangles, head = self.body.faces[self.faces], self.rest_joints[HEAD_JOINT]
        return face_points(self.rest_vertices, head, triangles, self.parts, self.barycentric)

    def on_topology(self, change: TopologyChange) -> None:
        """Rows of the surface follow; a child keeps its parent's weights, part and face."""
        for name in ("log_weights", "parts", "faces", "barycentric"):
            setattr(self, name, getattr(self, name)[change.source].contiguous())
        self.neighbours = self._cached = self._last = self._held = None

    def regularizers(self) -> dict[str, Tensor]:
        """Means over points (or cells) of squared quantities, but for the sparsity.

        "offset": canonical offsets, m^2. "laplacian": offset against its neighbours' mean, m^2
        (the paper's L_reg); "laplacian_scale", "laplacian_color": log-scale and RGB likewise
        (`laplacian_of`). "skinning": distance to the template's weights (HUGS).
        "scale": of log-scales from the template's. "time_smoothness", "time_sparsity": see
        PairedPlanes.

        Those of points are of the last forward pass, whose graph they share: add them to the
        same loss.
        """
        penalties = {
            "time_smoothness": self.planes.time_smoothness(),
            "time_sparsity": self.planes.time_sparsity(),
        }
        if self._last is not None:
            attributes, weights = self._last
            offsets = attributes.offsets
            penalties["offset"] = offsets.square().sum(-1).mean()
            penalties["scale"] = attributes.log_scales.square().mean()
            if attributes.weights is not None:
                drift = weights - self.log_weights.softmax(-1)
                penalties["skinning"] = drift.square().sum(-1).mean()
            penalties |= self._roughness(attributes)
        return penalties

    def _roughness(self, attributes: CanonicalAttributes) -> dict[str, Tensor]:
        """The Laplacian penalties, over points or over the mesh."""
        if self.edges is not None:
            points = (self.rest_vertices - self.rest_joints[PELVIS]) / self.half_box
            attributes = self.head(self.planes(points))
        return laplacians(attributes, self.smoothed, self.neighbours, self.edges)
