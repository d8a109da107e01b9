"""A human that is posed by a body model: what every skinned deformation shares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.body import (
    LEFT_FOOT,
    LEFT_WRIST,
    PELVIS,
    RIGHT_FOOT,
    RIGHT_WRIST,
    BodyModel,
    BodySurface,
)
from hoigs.core.clip import Clip
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import BodyPose, Moment
from hoigs.plugins.deformation.pose_refinement import PoseRefinement
from hoigs.plugins.deformation.skinning import ancestry

ScaleAbout = Literal["pelvis", "camera"]

APART = 0.05  # metres; rest made with another seed is decimetres off, a padded one centimetres
ANCHORS = (PELVIS, LEFT_WRIST, RIGHT_WRIST, LEFT_FOOT, RIGHT_FOOT)


class SkinnedBody(DeformationModel):
    """Poses by entity name, their refinement, the learnable scale alpha, and the skeleton.

    Args:
        body: the skinned body; neither trained nor stored in checkpoints.
        entity: name of the human, under which moments carry its pose.
        betas: shape for which rest was made; zeros when absent.
        num_frames: of the clip; needed to refine poses.
        trained_frames: frames whose poses are refined; the others follow (PoseRefinement).
        camera_centers: [F, 3], metres, needed to scale about the camera.
        refine_poses: learn corrections of pose, translation and shape.
        scale_about: the fixed point of alpha = exp(log_alpha): the "pelvis", or the "camera".
    """

    provides = frozenset({"skeleton"})
    residuals = frozenset({"means", "pose"})
    rest_space = "canonical"

    betas: Tensor
    rest_vertices: Tensor
    rest_joints: Tensor
    ancestors: Tensor
    camera_centers: Tensor | None

    def __init__(
        self,
        body: BodyModel,
        *,
        entity: str,
        betas: Float[Tensor, " B"] | None,
        num_frames: int | None,
        trained_frames: Sequence[int] | None,
        camera_centers: Float[Tensor, "F 3"] | None,
        refine_poses: bool,
        scale_about: ScaleAbout,
    ) -> None:
        super().__init__()
        if scale_about == "camera" and camera_centers is None:
            raise ValueError('scale_about "camera" needs camera_centers, one a frame')
        # in a tuple, so that the body is no submodule: its data belongs to no checkpoint
        self._body = (body,)
        self.entity = entity
        self.log_alpha = nn.Parameter(torch.zeros(()))
        self.refinement: PoseRefinement | None = None
        if refine_poses:
            if num_frames is None:
                raise ValueError("refine_poses needs num_frames, the length of the clip")
            self.refinement = PoseRefinement(num_frames, body.num_betas, trained_frames)
        betas = torch.zeros(body.num_betas) if betas is None else betas.detach().clone()
        with torch.no_grad():
            vertices, joints = body.shaped(betas)
        for name, value in {
            "betas": betas,
            "rest_vertices": vertices,
            "rest_joints": joints,
            "ancestors": ancestry(body.parents),
            "camera_centers": camera_centers if scale_about == "camera" else None,
        }.items():
            self.register_buffer(name, value, persistent=False)
        self._shape: tuple[Tensor, Tensor, Tensor] | None = None
        self._arm: tuple[Tensor, Tensor] | None = None

    @property
    def body(self) -> BodyModel:
        return self._body[0]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.body._apply(fn, recurse)
        self._shape = self._arm = None
        return super()._apply(fn, recurse)

    def set_trained_frames(self, indices: Sequence[int]) -> None:
        """Frames whose poses are refined; the others are interpolated from these."""
        if self.refinement is not None:
            self.refinement.set_trained_frames(indices)

    def pose(self, moment: Moment) -> BodyPose:
        """The pose that `moment` brings for this human, refined; without the interaction."""
        if self.entity not in moment.poses:
            raise ValueError(
                f'the moment has no body pose for "{self.entity}"; it has '
                f"{sorted(moment.poses) or 'none'}"
            )
        pose = moment.poses[self.entity]
        return pose if self.refinement is None else self.refinement(pose, moment.time)

    def shaped(self, betas: Float[Tensor, " B"]) -> tuple[Tensor, Tensor]:
        """Vertices and joints of the zero pose; the last shape without gradient is kept."""
        if betas.requires_grad and torch.is_grad_enabled():
            return self.body.shaped(betas)
        if self._shape is None or not torch.equal(self._shape[0], betas):
            self._shape = (betas.detach().clone(), *self.body.shaped(betas.detach()))
        return self._shape[1], self._shape[2]

    def posed_joints(
        self, pose: BodyPose, transforms: Float[Tensor, "J 4 4"], joints: list[int]
    ) -> Float[Tensor, "A 3"]:
        """World positions of some joints, before alpha."""
        places, turns = self.shaped(pose.betas)[1][joints], transforms[joints]
        return (turns[:, :3, :3] @ places[..., None]).squeeze(-1) + turns[:, :3, 3]

    def scaled(
        self, points: Float[Tensor, "N 3"], pelvis: Float[Tensor, " 3"], moment: Moment
    ) -> Float[Tensor, "N 3"]:
        """alpha: points scaled about the pelvis, or along the rays of the camera."""
        center = pelvis
        if self.camera_centers is not None:
            last = len(self.camera_centers) - 1
            center = self.camera_centers[min(max(round(moment.time * last), 0), last)]
        return center + self.log_alpha.exp() * (points - center)

    @torch.no_grad()
    def anchors(self, moment: Moment) -> Float[Tensor, "A 3"]:
        """Pelvis, wrists and feet in the world, without gradient."""
        pose = self.pose(moment)
        transforms = self.body.skinning_transforms(pose)
        joints = self.posed_joints(pose, transforms, list(ANCHORS))
        return self.scaled(joints, joints[0], moment)

    def arm_length(self) -> Float[Tensor, ""]:
        betas = self.betas
        if self.refinement is not None:
            betas = betas + self.refinement.betas.detach()
        if self._arm is None or not torch.equal(self._arm[0], betas):
            self._arm = (betas.clone(), self.body.arm_length(betas))
        return self._arm[1] * self.log_alpha.exp()


def context_settings(context: BuildContext, what: str) -> dict[str, Any]:
    """Constructor arguments that the clip decides: entity, seed, betas, num_frames, and those of
    `clip_settings`.

    Raises:
        ValueError: no body; `what` names the component.
    """
    if context.body is None:
        raise ValueError(f"{what} needs a body; it suits entities of kind human")
    settings: dict[str, Any] = {"entity": context.entity, "seed": context.seed}
    if context.body_track is not None:
        betas = context.body_track.poses.betas
        settings["betas"] = betas if betas.dim() == 1 else betas.mean(0)
        settings["num_frames"] = len(context.body_track.poses.transl)
    if context.clip is not None:
        settings |= clip_settings(context.clip)
    return settings


def checked_surface(surface: BodySurface, rest: Gaussians) -> BodySurface:
    """`surface`, if rest Gaussians were made of it.

    Raises:
        ValueError: another count, or the points stand apart.
    """
    if len(surface.points) != len(rest):
        raise ValueError(
            f"{len(rest)} rest Gaussians, but a surface of {len(surface.points)} points"
        )
    apart = (surface.points - rest.means.detach()).norm(dim=-1)
    if len(apart) and apart.median() > APART:
        raise ValueError(
            f"rest Gaussians stand {apart.median():.2f} m from the surface that weights them; "
            "make rest with body.rest(count, betas, seed) of the same betas "
            "and seed, or pass its `surface`"
        )
    return surface


def clip_settings(clip: Clip) -> dict[str, Any]:
    """What a clip says of the arguments of SkinnedBody."""
    train = {clip.moments[i].index for i in clip.split.get("train", range(len(clip)))}
    by_frame = {m.index: c for m, c in zip(clip.moments, clip.cameras, strict=True)}
    return {
        "num_frames": clip.num_frames,
        "trained_frames": sorted(train),
        "camera_centers": torch.stack([by_frame[i].center for i in sorted(by_frame)]),
    }
