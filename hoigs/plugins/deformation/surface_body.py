"""Gaussians on the surface of a skinned body: what all avatars share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from hoigs.core.interfaces.body import HEAD_PART, PELVIS, BodySurface
from hoigs.core.interfaces.deformation import Template
from hoigs.core.maths.nearest import mesh_roughness, point_roughness
from hoigs.core.maths.rows import rows_of
from hoigs.core.maths.skinning import joint_turns, skin_gaussians
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment, ResidualRule
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.human_planes import CanonicalAttributes
from hoigs.plugins.deformation.irradiance import turned_normals
from hoigs.plugins.deformation.skinned_body import SkinnedBody, checked_surface

# Which points of a body are its face, found from its shape.

HEAD_JOINT = 15  # of SMPL-X's order, at the height of the ears' lower ends
FORWARD = 0.35  # cosine between a face's normal and straight ahead


def face_points(
    vertices: Float[Tensor, "V 3"],
    head: Float[Tensor, " 3"],
    triangles: Int[Tensor, "N 3"],
    parts: Int[Tensor, " N"],
    barycentric: Float[Tensor, "N 3"],
) -> tuple[Int[Tensor, " F"], Float[Tensor, "F 3"]]:
    """Rows of surface points on the face, and their outward unit normals.

    Every body faces +z in its zero pose, so the face is the part of the head whose normals point
    ahead, from a quarter of the head's height below its joint (the chin; the neck belongs to the
    same part) to four fifths of it above (the hair).

    Args:
        vertices: vertices in the zero pose, metres. head: joint 15 there.
        triangles: corners of the triangle on which each point lies.
        parts: body part of each point.
    """
    a, b, c = vertices[triangles].unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    height = (vertices[triangles] * barycentric[..., None]).sum(1)[:, 1] - head[1]
    mine = parts == HEAD_PART
    if not mine.any():
        return mine.nonzero().squeeze(1), normals[:0]
    top = height[mine].max()
    ahead = (normals[:, 2] > FORWARD) & (height > -0.25 * top) & (height < 0.8 * top)
    rows = (mine & ahead).nonzero().squeeze(1)
    return rows, normals[rows]


OPAQUE = 4.6  # logit of 0.99, the largest opacity that rasterizers draw


class SurfaceBody(SkinnedBody):
    """Points of the body's surface with the skinning weights, body part and triangle of each.

    The canonical Gaussians lie on `surface`, or, if none is given, on
    `body.surface(len(canonical), betas, seed)`: they must have been made by the same call.
    """

    provides = frozenset({"skeleton", "face"})
    rates: ClassVar[Mapping[str, str]] = {"refinement": "pose", "refinement.betas": "shape"}
    transient: ClassVar[Mapping[str, Any]] = {"_change": None}

    template_weights: Tensor
    parts: Tensor
    faces: Tensor
    barycentric: Tensor
    normals: Tensor
    _change: Tensor | None = None  # `shape_change` while held

    def point_rows(self, surface: BodySurface) -> dict[str, Tensor]:
        """Buffers with one row for each Gaussian, which follow changes of their number."""
        return {
            "template_weights": surface.weights,
            "parts": surface.parts,
            "faces": surface.faces,
            "barycentric": surface.barycentric,
            "normals": surface.normals,
        }

    def bind(self, canonical: Gaussians) -> None:
        made = self._surface or self.body.surface(len(canonical), self.betas, self.seed)
        rows = self.point_rows(checked_surface(made, canonical))
        for name, value in rows.items():
            self.register_buffer(name, value.detach().clone())
        self._row_names, self._surface = tuple(rows), None

    def on_topology(self, change: TopologyChange) -> None:
        """A child keeps the rows of its parent: weights, part and triangle."""
        for name in self._row_names:
            setattr(self, name, getattr(self, name)[change.source].contiguous())

    @torch.no_grad()
    def hold(self, canonical: Gaussians, moment: Moment) -> None:
        """As SkinnedBody, and the change of each canonical point by the shape of `moment`."""
        super().hold(canonical, moment)
        self._change = self._changed(self.shaped(self.pose(moment).betas, moment)[0])

    def shaped_pose(
        self, moment: Moment, residual: Residual | None, rule: ResidualRule = "add"
    ) -> tuple[BodyPose, Float[Tensor, "V 3"], Float[Tensor, "J 3"]]:
        """theta_final of HOIGS, Eq. 13, and the vertices and joints of the zero pose, metres."""
        pose = self.pose(moment)
        shape = self.shaped(pose.betas, moment)
        if residual is not None and residual.pose is not None:
            pose = pose.with_residual(residual.pose, rule)
        return pose, *shape

    def shape_change(
        self, pose: BodyPose, vertices: Float[Tensor, "V 3"], moment: Moment
    ) -> Float[Tensor, "N 3"] | None:
        """Displacement of each canonical point by the betas of `pose`, metres; None if these are
        the betas of the canonical Gaussians.

        Args:
            vertices: vertices in the zero pose, with the shape of `pose`.
        """
        if self.held:
            return self._change
        return self._changed(vertices) if self.reshaped(pose.betas, moment) else None

    def _changed(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "N 3"]:
        corners = rows_of(vertices - self.rest_vertices, self.body.faces[self.faces])
        return (corners * self.barycentric[..., None]).sum(1)

    def posed(
        self,
        canonical: Gaussians,
        weights: Float[Tensor, "N J"],
        pose: BodyPose,
        joints: Float[Tensor, "J 3"],
        moment: Moment,
        residual: Residual | None,
    ) -> Gaussians:
        """alpha LBS(P_c, theta, W) (HOIGS, Eq. 6 and 14), plus the residual of the means, in the
        light there.

        Args:
            canonical: Gaussians of the zero pose. joints: zero-pose joints with the
                shape of `pose`, metres.
        """
        transforms = self.body.skinning_transforms(pose)
        turns = joint_turns(transforms, self.body.parents, self.ancestors)
        pelvis = self.posed_joints(joints, transforms, (PELVIS,))[0]
        # scaling the joints' transforms scales every point, as its weights sum to one
        scaled = self.scaled_transforms(transforms, pelvis, moment)
        means, quats = skin_gaussians(canonical.means, canonical.quats, weights, scaled, turns)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        posed = replace(
            canonical, means=means, quats=quats, log_scales=canonical.log_scales + self.log_alpha
        )
        if self.irradiance is None:
            return posed
        return self.irradiance(posed, turned_normals(self.normals, canonical.quats, quats))

    def surface_points(self) -> Float[Tensor, "N 3"]:
        """Where each canonical point lies on the template in its zero pose, metres."""
        corners = self.rest_vertices[self.body.faces[self.faces]]
        return (corners * self.barycentric[..., None]).sum(1)

    def template(self, canonical: Gaussians) -> Template:
        """The surface that the Gaussians belong to; `canonical` are drawn as they are."""
        corners = self.rest_vertices[self.body.faces[self.faces]]
        points = self.surface_points()
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = torch.zeros_like(points)
        middle[:, 0] = 2 * (self.rest_joints[PELVIS, 0] - points[:, 0])
        normals = normalize(normals, dim=-1)
        weights = getattr(self, "template_weights", None)
        return Template(canonical, points, normals, points + middle, self.parts, weights)

    def point_parts(self) -> Int[Tensor, " N"]:
        return self.parts

    def face_points(self) -> tuple[Int[Tensor, " F"], Float[Tensor, "F 3"]]:
        triangles, head = self.body.faces[self.faces], self.rest_joints[HEAD_JOINT]
        return face_points(self.rest_vertices, head, triangles, self.parts, self.barycentric)


# How rough attributes are over a body's surface: L_reg of HOIGS, Eq. 16, as ExAvatar has it.

LaplacianOn = Literal["points", "mesh"]
Smoothed = Literal["offset", "scale", "color"]


def laplacians(
    attributes: CanonicalAttributes,
    smoothed: Sequence[Smoothed],
    neighbours: Int[Tensor, "N k"] | None,
    edges: Int[Tensor, "E 2"] | None,
) -> dict[str, Tensor]:
    """The penalties "laplacian" (of offsets), "laplacian_scale", "laplacian_color", by `smoothed`.

    Args:
        attributes: one row a vertex if there are edges, else one a point with neighbours.
    """
    choices = {
        "offset": ("laplacian", attributes.offsets),
        "scale": ("laplacian_scale", attributes.log_scales),
        "color": ("laplacian_color", attributes.colors),
    }
    penalties = {}
    for name, values in (choices[what] for what in smoothed):
        if edges is not None:
            penalties[name] = mesh_roughness(values, edges)
        elif neighbours is not None:
            penalties[name] = point_roughness(values, neighbours)
    return penalties
