"""deformation:hexplane-skinning: the human of HOIGS (Sec. "Human Deformation")."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.interfaces.body import PELVIS, BodyModel, BodySurface
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import Template
from hoigs.core.maths.frame_times import at_frame
from hoigs.core.maths.nearest import mesh_edges, neighbours_of
from hoigs.core.maths.skinning import skin
from hoigs.core.model.object_placement import masked_depths, seen_middle
from hoigs.core.values.clip import BodyTrack, Clip
from hoigs.core.values.gaussians import SH_C0, GaussianDelta, Gaussians
from hoigs.core.values.moment import Moment, ResidualRule
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.human_planes import (
    CanonicalAttributes,
    CanonicalHead,
    Fusion,
    HeadKind,
    body_planes,
    field_subset,
)
from hoigs.plugins.deformation.nonrigid import NonRigid, NonRigidConfig, NonRigidMotion, Shading
from hoigs.plugins.deformation.skinned_body import SkinnedBodyConfig, exact_poses
from hoigs.plugins.deformation.surface_body import (
    OPAQUE,
    LaplacianOn,
    Smoothed,
    SurfaceBody,
    laplacians,
)

# Where the learnable scale alpha of HOIGS, Eq. 6, starts: at one, or at a ratio of depths.

AlphaStart = Literal["one", "depth"]
FRAMES = 16  # a median over more of them is the same


@torch.no_grad()
def depth_ratio(clip: Clip, entity: str, body: BodyModel, track: BodyTrack) -> float:
    """Median over frames of the clip's depth under a human's mask, divided by that of the front of
    the posed body.

    Masks that touch the border of the image show only a part of the body and are left out, unless
    all do.

    Raises:
        ValueError: the clip has no metric depth under this human's mask.
    """
    ratios: dict[bool, list[float]] = {True: [], False: []}
    for position in range(0, len(clip), max(1, len(clip) // FRAMES)):
        frame = clip[position]
        mask, view = frame.masks[entity], frame.camera.world_to_camera
        middle, _, known = masked_depths([mask], [frame.depth])
        if not known[0]:
            continue
        posed = body(track.poses.frame(frame.moment.index))
        about = (posed.vertices - posed.joints[PELVIS]) @ view[:3, :3].mT
        front = frame.camera.to_camera(posed.joints[PELVIS])[2] + seen_middle(about)[2]
        cut = bool(mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any())
        if front > 0:
            ratios[cut].append(float(middle[0] / front))
    found = ratios[False] or ratios[True]
    if clip.depth_kind != "metric" or not found:
        raise ValueError(
            f'alpha_start: "depth" needs metric depth under the mask of "{entity}"; this clip\'s '
            f'depth is {clip.depth_kind}; use "one"'
        )
    return float(torch.tensor(found).median())


# Settings of deformation:hexplane-skinning.


class HexPlaneSkinningConfig(SkinnedBodyConfig):
    """The paper's human; sizes that the paper does not give are ExAvatar's."""

    fusion: Fusion = "paired"
    """How six planes give 96 features. "paired" multiplies each space plane with the time plane of
    the third axis and concatenates the three (HexPlane); it is the default, as f and phi come from
    the same planes, 3 x 32 wide. "product" multiplies all six, at three resolutions (4DGS,
    K-Planes)."""
    resolution: int = Field(default=128, ge=2)
    """Cells along each space axis of the feature planes."""
    channels: int = Field(default=32, ge=1)
    """Channels of each feature plane."""
    time_resolution: int | None = Field(default=None, ge=0)
    """Cells along time. None is half the frames; 0 leaves the time planes out, for a human whose
    tokens nothing reads."""
    box: float = Field(default=2.5, gt=0)
    """Side of the cube about the pelvis that the planes cover, metres."""
    width: int = Field(default=128, ge=8)
    """Width of the hidden layers of psi_h."""
    head: HeadKind = "full"
    """What psi_h predicts: "full" is the paper's colour, opacity, offset, rotation, scale and
    skinning weights; "exavatar" colour, offset and one isotropic scale, of opaque Gaussians."""
    free_attributes: bool | Literal["all"] = True
    """Train each Gaussian's own colour, opacity and scale too, to which psi_h then adds; they
    converge sooner. "all" trains its mean and rotation as well, so that it may leave the surface of
    the template. False is the paper: all comes from the planes."""
    scale_about: Literal["pelvis", "camera"] = "pelvis"
    """The fixed point of alpha, which the paper does not give (with the world's origin the person
    would move). "pelvis", the default, changes the person's size, which images show; "camera"
    changes the depth but not the image, so that only L_depth can learn alpha."""
    alpha_start: AlphaStart = "one"
    """Alpha at the start: "one", or the ratio of the clip's metric "depth" to the body's own, which
    fits the scale about the camera."""
    field_points: int = Field(default=1536, ge=16)
    """Body points at which phi is read, spread over the 16 parts."""
    field_at: Literal["posed", "canonical"] = "posed"
    """"posed" reads phi where the body is (the supplement's "dynamic coordinates", relative to the
    pelvis, as planes over the world would leave most cells unused); "canonical" on the body in its
    zero pose, so that only time changes a token."""
    residual_rule: ResidualRule = "add"
    """How delta theta joins theta: "add" axis-angles, as the paper prints it, or "compose"
    rotations, which differs for large angles."""
    nonrigid: bool | Literal["auto", "shading"] = False
    """What is learned beside the skeleton, at every time. True: an offset and a change of colour of
    every canonical point, for clothes, hair, soft tissue and what is wrong with a pose. "shading":
    how bright it is, for light and shadow on people who are rigid between their joints. "auto":
    True, or "shading" where the clip declares its poses to be exact, as built-in clips do. False is
    the paper's Eq. 5."""
    nonrigid_motion: NonRigidConfig = Field(default_factory=NonRigidConfig)
    """Sizes of what `nonrigid` learns."""
    shading: NonRigidConfig | None = None
    """Sizes where it is "shading", which is smoother than motion; None: as `nonrigid_motion`."""
    laplacian: LaplacianOn = "points"
    """Where L_reg of psi_h is taken: over neighbouring "points", the Gaussians, at no further cost;
    or over the vertices of the body's "mesh" (the paper), by a second pass of psi_h, but then
    neighbours never reach from one thigh to the other."""
    laplacian_of: tuple[Smoothed, ...] = ("offset",)
    """What L_reg smooths: "offset", "scale" and "color" (ExAvatar), or fewer."""


class HexPlaneSkinning(SurfaceBody):
    """G_human = alpha LBS(P_c, theta, W), with psi_h(f(T_c)) = (c, o, dP_c, R, S, W) (Eq. 5, 6).

    T_c is the zero pose. f and phi come from the same planes: f is read at canonical points, phi
    (Eq. 7) at posed ones, both relative to the pelvis and before alpha. Everything that is learned
    starts where it changes nothing, so that the human starts as its skinned template.

    For the arguments besides the config see SkinnedBody; `num_frames` also gives the default time
    resolution.

    Raises:
        ValueError: `scale_about` is "camera" without `camera_centers`.
    """

    Config: ClassVar = HexPlaneSkinningConfig
    provides = frozenset({"field", "skeleton", "face"})
    cuda_graph_safe = True
    learns_scale = True
    rates: ClassVar[Mapping[str, str]] = {
        "planes": "planes",
        "nonrigid.planes": "planes",
        **SurfaceBody.rates,
        "log_alpha": "shape",
    }
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "offset": 1.0,
        "drift": 30.0,
        "laplacian": 10.0,
        "laplacian_scale": 0.1,
        "laplacian_color": 0.1,
        "skinning": 1.0,
        "time_smoothness": 0.01,
        "time_sparsity": 1e-4,
        "nonrigid": 1.0,
        "shading": 0.5,
        "nonrigid_smoothness": 0.01,
        "nonrigid_sparsity": 1e-4,
    }
    transient: ClassVar[Mapping[str, Any]] = {
        "_cached": None,
        "_own": None,
        "_last": None,
        "_changes": {},
        "_held": None,
    }

    field_vertices: Tensor
    log_weights: Tensor
    neighbours: Tensor | None
    edges: Tensor | None

    def _build(self) -> None:
        config, body = self.config, self.body
        if config.scale_about == "camera" and self.camera_centers is None:
            raise ValueError('scale_about "camera" needs camera_centers, one for each frame')
        self.half_box = config.box / 2
        self.opaque = config.head == "exavatar"
        edges = mesh_edges(body.faces) if config.laplacian == "mesh" else None
        self.register_buffer("edges", edges, persistent=False)
        time_resolution = config.time_resolution
        if time_resolution is None:
            time_resolution = max(8, (self.num_frames or 64) // 2)
        self.planes = body_planes(
            config.fusion, config.channels, config.resolution, time_resolution
        )
        self.head = CanonicalHead(self.planes.width, len(body.parents), config.width, config.head)
        self.nonrigid: NonRigid | None = None
        if config.nonrigid:
            shading = config.nonrigid == "shading"
            kind = Shading if shading else NonRigidMotion
            sizes = (config.shading if shading else None) or config.nonrigid_motion
            self.nonrigid = kind(sizes, self.num_frames or 0)
        owned: set[str] = set() if config.free_attributes == "all" else {"means", "quats"}
        owned |= {"opacity_logits"} if self.opaque else set()
        if not config.free_attributes:
            owned = {"means", "quats", "log_scales", "opacity_logits", "sh"}
        self.owns = frozenset(owned)
        field = field_subset(body.vertex_parts, config.field_points)
        self.register_buffer("field_vertices", field, persistent=False)
        self._cached: tuple[object, CanonicalAttributes, Tensor] | None = None
        self._own: tuple[object, Tensor] | None = None
        self._last: tuple[CanonicalAttributes, Tensor, Tensor] | None = None
        self._changes: dict[str, Tensor] = {}  # by `nonrigid` in the last forward pass
        self._held: tuple[Gaussians, Tensor] | None = None

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        clip, track = context.clip, context.body_track
        if config.nonrigid == "auto":
            config = config.model_copy(
                update={"nonrigid": "shading" if exact_poses(clip) else True}
            )
        made = super().from_config(config, context)
        if config.alpha_start == "depth" and clip is not None and track is not None:
            ratio = depth_ratio(clip, context.entity, made.body, track)
            nn.init.constant_(made.log_alpha, math.log(ratio))
        return made

    def point_rows(self, surface: BodySurface) -> dict[str, Tensor]:
        rows = {
            "log_weights": (surface.weights + 1e-6).log(),
            "parts": surface.parts,
            "faces": surface.faces,
            "barycentric": surface.barycentric,
        }
        return rows if self.irradiance is None else {**rows, "normals": surface.normals}

    def bind(self, canonical: Gaussians) -> None:
        super().bind(canonical)
        self.register_buffer("neighbours", neighbours_of(canonical.means), persistent=False)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        pose, vertices, joints = self.shaped_pose(moment, residual, self.config.residual_rule)
        if self._held is not None and self.held:
            refined, weights = self._held
        else:
            attributes, weights = self._attributes(canonical)
            change = self.shape_change(pose, vertices, moment)
            refined = self._canonical(canonical, attributes, change)
        if self.nonrigid is not None:
            points = self._plane_points(canonical.means)
            delta, changes = self.nonrigid.change(refined, points, moment.time)
            self._changes = changes if self._remembers() else {}
            refined = refined.moved(delta)
        return self.posed(refined, weights, pose, joints, moment, residual)

    @torch.no_grad()
    def hold(self, canonical: Gaussians, moment: Moment) -> None:
        """As SurfaceBody, and the canonical Gaussians with it."""
        super().hold(canonical, moment)
        attributes, weights = self._attributes(canonical)
        self._held = (self._canonical(canonical, attributes, self._change), weights)

    def scale_center(self, pelvis: Float[Tensor, " 3"], moment: Moment) -> Float[Tensor, " 3"]:
        if self.config.scale_about == "pelvis" or self.camera_centers is None:
            return pelvis
        return at_frame(self.camera_centers, moment.time, self.frame_times)

    def template(self, canonical: Gaussians) -> Template:
        attributes, weights = self._attributes(canonical)
        drawn = self._canonical(canonical, attributes, None)
        return replace(super().template(canonical), gaussians=drawn, weights=weights)

    def _attributes(self, canonical: Gaussians) -> tuple[CanonicalAttributes, Float[Tensor, "N J"]]:
        """psi_h of every canonical point, and its skinning weights.

        Neither depends on time, so both are cached in eval mode. They are not in training mode, as
        fused optimizers change parameters without a change of their version.
        """
        keep = not self.training and not torch.is_grad_enabled()
        sources = (
            canonical.means,
            self.log_weights,
            *self.planes.parameters(),
            *self.head.parameters(),
        )
        state = [(x.data_ptr(), x._version) for x in sources] if keep else []
        if keep and self._cached is not None and self._cached[0] == state:
            return self._cached[1], self._cached[2]
        attributes = self._predicted(canonical.means)
        logits = self.log_weights
        if attributes.weights is not None:
            logits = logits + attributes.weights
        weights = logits.softmax(-1)
        if self._remembers():
            self._remember(attributes, weights, canonical.means)
        elif keep:
            self._cached = (state, attributes, weights)
        return attributes, weights

    def _own_weights(self) -> Float[Tensor, "N J"]:
        """The body's own skinning weights of every point; cached, except where graphs are captured
        and memory of one capture must not be read by another."""
        if self.log_weights.is_cuda:
            return self.log_weights.softmax(-1)
        state = (self.log_weights.data_ptr(), self.log_weights._version)
        if self._own is None or self._own[0] != state:
            self._own = (state, self.log_weights.softmax(-1))
        return self._own[1]

    def _predicted(self, points: Float[Tensor, "N 3"]) -> CanonicalAttributes:
        """psi_h(f) at points of the zero pose, metres."""
        return self.head(self.planes(self._plane_points(points)))

    def _plane_points(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Points of the zero pose, metres, in the coordinates of the planes: [-1, 1]."""
        return (points - self.rest_joints[PELVIS]) / self.half_box

    def _remembers(self) -> bool:
        """Whether `regularizers` may follow, for whose sake outputs are kept."""
        return self.training and torch.is_grad_enabled()

    def train(self, mode: bool = True) -> Self:
        self._cached = self._held = None
        if not mode:
            self._last, self._changes = None, {}  # no model is copied with the graph of a step
        return super().train(mode)

    def _remember(self, attributes: CanonicalAttributes, weights: Tensor, means: Tensor) -> None:
        """Keep the outputs of this forward pass for `regularizers`, until their graph is freed."""
        self._last = (attributes, weights, means)
        if attributes.offsets.requires_grad:

            def forget(gradient: Tensor) -> None:
                self._last, self._changes = None, {}

            attributes.offsets.register_hook(forget)

    def _canonical(
        self,
        canonical: Gaussians,
        attributes: CanonicalAttributes,
        change: Float[Tensor, "N 3"] | None,
    ) -> Gaussians:
        """Gaussians of the zero pose, in another shape if `change` is its displacement, metres."""
        offsets = attributes.offsets
        bands = canonical.sh.shape[1]
        refined = canonical.moved(
            GaussianDelta(
                means=offsets if change is None else offsets + change,
                quats=attributes.quats,
                log_scales=attributes.log_scales,
                opacity_logits=attributes.opacity_logits,
                sh=nn.functional.pad(attributes.colors[:, None] / SH_C0, (0, 0, 0, bands - 1)),
            )
        )
        if self.opaque:
            logits = torch.full_like(refined.opacity_logits, OPAQUE)
            refined = replace(refined, opacity_logits=logits)
        return refined

    def posed_field(
        self, canonical: Gaussians, moment: Moment
    ) -> tuple[Float[Tensor, "V F"], Float[Tensor, "V 3"]]:
        """phi at the body, relative to its pelvis and before alpha, and the points in the world.

        The body points are vertices of the template, so that every part has features however few
        Gaussians there are. Features have gradients in the planes but not in the pose: the person's
        motion is learned from images, not from where its features are read.
        """
        with torch.no_grad():
            body = self.posed_body(moment)
            points = body.vertices.index_select(0, self.field_vertices)
            weights = self.body.skinning_weights.index_select(0, self.field_vertices)
            posed = skin(points, body.transforms, weights)
            pelvis = self.posed_joints(body.joints, body.transforms, (PELVIS,))[0]
            places = self.scaled(posed, pelvis, moment)
        at_posed = self.config.field_at == "posed"
        read = posed - pelvis if at_posed else points - self.rest_joints[PELVIS]
        return self.planes(read / self.half_box, moment.time), places

    def field_parts(self) -> Int[Tensor, " V"]:
        """Body part (0..15) of each point of `posed_field`."""
        return self.body.vertex_parts[self.field_vertices]

    @property
    def field_width(self) -> int:
        return self.planes.width

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        self.neighbours = self._cached = self._own = self._held = None
        self._last, self._changes = None, {}

    def regularizers(self) -> dict[str, Tensor]:
        """Means over points (or cells) of squares, except the sparsity.

        "offset": canonical offsets, m^2. "laplacian": offset against its neighbours' mean, m^2
        (L_reg of HOIGS, Eq. 16); "laplacian_scale", "laplacian_color": for log-scale, RGB
        (`laplacian_of`). "drift": means that are free against the template's surface, m^2.
        "skinning": distance to the body's own weights (HUGS). "scale": distance of log-scales to
        the template's. "time_smoothness", "time_sparsity": see PairedPlanes. "nonrigid": offsets
        of `NonRigidMotion`, m^2; "shading": exponents of `Shading`; planes of either have penalties
        of their own.

        Those of points share the graph of the last forward pass: add them to the same loss.
        """
        penalties = {
            "time_smoothness": self.planes.time_smoothness(),
            "time_sparsity": self.planes.time_sparsity(),
        }
        if self.nonrigid is not None:
            penalties |= self.nonrigid.penalties()
        for name, values in self._changes.items():
            penalties[name] = values.square().sum(-1).mean()
        if self._last is not None:
            attributes, weights, means = self._last
            if "means" not in self.owns:
                penalties["drift"] = (means - self.surface_points()).square().sum(-1).mean()
            penalties["offset"] = attributes.offsets.square().sum(-1).mean()
            penalties["scale"] = attributes.log_scales.square().mean()
            if attributes.weights is not None:
                drift = nn.functional.mse_loss(weights, self._own_weights(), reduction="sum")
                penalties["skinning"] = drift / len(weights)
            if self.edges is not None:
                attributes = self._predicted(self.rest_vertices)
            smoothed = self.config.laplacian_of
            penalties |= laplacians(attributes, smoothed, self.neighbours, self.edges)
        return penalties
