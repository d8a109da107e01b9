"""Gaussians that ride on the surface of a skinned body: what plain avatars share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.body import PELVIS, BodyModel, BodySurface
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import BodyPose, Moment
from hoigs.core.rotation import multiply_quats, normalize_quats
from hoigs.core.topology import TopologyChange
from hoigs.plugins.deformation.face_points import HEAD_JOINT, face_points
from hoigs.plugins.deformation.skinned_body import SkinnedBody, checked_surface
from hoigs.plugins.deformation.skinning import skin_points, skin_quats


class SurfaceBody(SkinnedBody):
    """Points of the body's surface with the skinning weights, part and triangle of each.

    The size of the body is the clip's (there is no learned alpha). The rest Gaussians lie on
    `surface`, or on `body.surface(len(rest), betas, seed)` when none is given.

    Args:
        body, entity, betas, num_frames, trained_frames, refine_poses: as SkinnedBody.
        surface: the points of rest. seed: of the surface, where none is given.
    """

    provides = frozenset({"skeleton", "face"})
    rates: ClassVar[Mapping[str, str]] = {"refinement": "pose", "refinement.betas": "shape"}

    template_weights: Tensor
    parts: Tensor
    faces: Tensor
    barycentric: Tensor
    normals: Tensor

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
        refine_poses: bool = False,
    ) -> None:
        super().__init__(
            body,
            entity=entity,
            betas=betas,
            num_frames=num_frames,
            trained_frames=trained_frames,
            camera_centers=None,
            refine_poses=refine_poses,
            scale_about="pelvis",
        )
        self.log_alpha.requires_grad_(False)
        self._surface, self.seed = surface, seed
        self._change: Tensor | None = None

    @torch.no_grad()
    def hold(self, rest: Gaussians, moment: Moment) -> None:
        """Where each point is at rest, too, in this moment's shape."""
        super().hold(rest, moment)
        self._change = self._changed(self.pose(moment), moment)

    def bind(self, rest: Gaussians) -> None:
        made = self._surface or self.body.surface(len(rest), self.betas, self.seed)
        surface = checked_surface(made, rest)
        for name, value in {
            "template_weights": surface.weights,
            "parts": surface.parts,
            "faces": surface.faces,
            "barycentric": surface.barycentric,
            "normals": surface.normals,
        }.items():
            self.register_buffer(name, value.detach().clone())
        self._surface = None

    def moved_pose(self, moment: Moment, residual: Residual | None) -> BodyPose:
        """The refined pose, with what the interaction adds to it."""
        pose = self.pose(moment)
        if residual is not None and residual.pose is not None:
            pose = pose.with_residual(residual.pose)
        return pose

    def shape_change(self, pose: BodyPose, moment: Moment) -> Float[Tensor, "N 3"] | None:
        """How far each point moves at rest because the pose has other betas, metres; None for
        not."""
        if self.held:
            return self._change
        return self._changed(pose, moment) if self.reshaped(pose.betas, moment) else None

    def _changed(self, pose: BodyPose, moment: Moment) -> Float[Tensor, "N 3"]:
        """`shape_change`, whatever the betas."""
        change = self.shaped(pose.betas, moment)[0] - self.rest_vertices
        return (change[self.body.faces[self.faces]] * self.barycentric[..., None]).sum(1)

    def posed(
        self,
        canonical: Gaussians,
        weights: Float[Tensor, "N J"],
        pose: BodyPose,
        moment: Moment,
        residual: Residual | None,
    ) -> Gaussians:
        """Gaussians of the zero pose, in the world."""
        transforms = self.body.skinning_transforms(pose)
        means = skin_points(canonical.means, weights, transforms)
        joints = self.shaped(pose.betas, moment)[1]
        means = self.scaled(means, self.posed_joints(joints, transforms, (PELVIS,))[0], moment)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        turns = skin_quats(weights, transforms, self.body.parents, self.ancestors)
        quats = multiply_quats(turns, normalize_quats(canonical.quats))
        return replace(canonical, means=means, quats=quats)

    def point_parts(self) -> Int[Tensor, " N"]:
        return self.parts

    def face_points(self) -> tuple[Int[Tensor, " F"], Float[Tensor, "F 3"]]:
        triangles, head = self.body.faces[self.faces], self.rest_joints[HEAD_JOINT]
        return face_points(self.rest_vertices, head, triangles, self.parts, self.barycentric)

    def on_topology(self, change: TopologyChange) -> None:
        """A child keeps its parent's weights, part, triangle and normal."""
        for name in ("template_weights", "parts", "faces", "barycentric", "normals"):
            setattr(self, name, getattr(self, name)[change.source].contiguous())
